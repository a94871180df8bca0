// SPDX-License-Identifier: Apache-2.0
// Weight and inertia of the tool, to be subtracted from force and torque, at their instant. docs/compensation.md has the model.
// As ros2_bridge/bota_ft_compensation: alignment, specific_force, compensator, stream.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <optional>
#include <string_view>
#include <utility>
#include <vector>

#include <bota_ethercat.hpp>

namespace bota_ethercat_hardware {

using bota_ethercat::kPi;
using bota_ethercat::kStandardGravity;
using bota_ethercat::Vector3;
using bota_ethercat::detail::length;
using bota_ethercat::detail::vector_product;
using Wrench = std::array<double, 6>;  // Fx Fy Fz (N) Mx My Mz (Nm), about the wrench origin

/// What hangs on the sensor's tool side, and what its accelerometer reads: `scale` times the truth plus `offset`, per axis.
struct Payload {
    double mass = 0.0;  ///< kg
    Vector3 center{};   ///< of gravity, m from the wrench origin
    std::array<double, 6> inertia{};  ///< Ixx Iyy Izz Ixy Ixz Iyz about it, kg m^2, in the sensor's axes; zeros: a point mass
    Vector3 accelerometer_offset{}, accelerometer_scale{1, 1, 1};  ///< m/s^2, none
    std::array<double, 6> accelerometer_cross_axis{};              ///< xy xz yx yz zx zy: of the first, part of the second subtracted
    // Half of the 95 % intervals; those of an inertia that is not identified are zeros.
    Vector3 center_interval{0.002, 0.002, 0.002}, offset_interval{0.784, 0.784, 0.784}, scale_interval{0.0098, 0.0098, 0.0098};
    std::array<double, 6> cross_axis_interval{0.0098, 0.0098, 0.0098, 0.0098, 0.0098, 0.0098}, inertia_interval{};
};

/// What the compensated wrench is wrong by without contact, in 95 % of samples: as bota_ft_compensation/bounds.py, which explains it.
/// `tared`: the bias is of a tare by this accelerometer. `felt`, m/s^2, at the center of gravity; `rate`, rad/s; `spin`, rad/s^2.
struct Bounds {
    double force, torque;  ///< N, Nm

    Bounds(const Payload& tool, bool tared, const Vector3& felt, const Vector3& rate, const Vector3& spin, double noise) noexcept {
        constexpr double kAxes = 2.80 / 1.96, kPoses = 4.39 / 1.96, kReach = 0.1, kLikely = 0.2, kTyped = 0.1;
        const auto& scale = tool.scale_interval;
        const auto& crossed = tool.cross_axis_interval;
        double largest = *std::max_element(crossed.begin(), crossed.end()), half = 0.0;
        for (std::size_t i = 0; i < 3; ++i) {
            const double part = std::max({scale[i], crossed[2 * i], crossed[2 * i + 1]});
            half = std::max(half, std::hypot(tool.offset_interval[i], kStandardGravity * part));
            largest = std::max(largest, scale[i]);
        }
        force = tool.mass * (tared ? kPoses * kStandardGravity * largest : kAxes * half);
        auto halves = tool.inertia_interval;
        if (halves == decltype(halves){}) {
            const double moment = *std::max_element(tool.inertia.begin(), tool.inertia.end());
            const double reach = tool.mass * (kReach * kReach + length(tool.center) * length(tool.center)), likely = kLikely * reach;
            if (moment > 0.0) halves.fill(kTyped * moment);
            else halves = {likely + reach, likely + reach, likely + reach, likely, likely, likely};
        }
        const double off_center = (tared ? kPoses : kAxes) * tool.mass * length(felt) *
                                  *std::max_element(tool.center_interval.begin(), tool.center_interval.end());
        const double arm = force * length(tool.center), sideways = 0.5 * length(rate) * spread(halves, rate), turned = spread(halves, spin);
        torque = std::sqrt(turned * turned + sideways * sideways + off_center * off_center + arm * arm + noise * noise);
    }

private:
    static double spread(const std::array<double, 6>& halves, const Vector3& v) noexcept {
        const auto squared = [&halves](int i) { return halves[static_cast<std::size_t>(i)] * halves[static_cast<std::size_t>(i)]; };
        return std::sqrt((squared(0) + squared(3) + squared(4)) * v[0] * v[0] + (squared(3) + squared(1) + squared(5)) * v[1] * v[1] +
                         (squared(4) + squared(5) + squared(2)) * v[2] * v[2]);
    }
};

/// How the offset that the sensor itself adds (object 0x8000) changes a bias: as bota_ft_compensation/stream.py.
class OwnOffset {
public:
    using Known = std::optional<Wrench>;

    /// There is a bias, and it goes with this offset.
    void begin(const Known& of_bias) noexcept { has_bias_ = true, of_bias_ = of_bias, appeared_ = false, change_ = {}; }

    /// Whether the offset is another one, by which `change` is another, too. Unknown is also one that is being changed.
    bool follow(const Known& now) noexcept {
        is_doubtful_ = of_bias_ && !now;
        if (!now || now == of_bias_) return false;
        const Known before = std::exchange(of_bias_, now);
        appeared_ = has_bias_ && !before;
        if (before && has_bias_)
            for (std::size_t i = 0; i < change_.size(); ++i) change_[i] += (*now)[i] - (*before)[i];
        return before.has_value();
    }

    /// What is to be added to the bias.
    const Wrench& change() const noexcept { return change_; }
    /// Whether the bias may not fit samples with the offset of the last `follow`.
    bool is_doubtful() const noexcept { return is_doubtful_ || appeared_; }

private:
    bool has_bias_ = false, appeared_ = false, is_doubtful_ = false;
    Known of_bias_;  // or the last without a bias
    Wrench change_{};
};

/// By a model's name, such as BFT-SENS-ECAT-M8: z of the IMU from the wrench origin, m; 0 if it is not known.
inline double imu_height(std::string_view model) noexcept {
    constexpr std::pair<std::string_view, double> kHeights[] = {
        {"SENS", 0.0093 - 0.035}, {"ROKS", 0.0098 - 0.032}, {"ROKA", 0.0098 - 0.032}, {"MEDS", 0.0098 - 0.032},
        {"MEDA", 0.0098 - 0.032}, {"LAXS", 0.01195 - 0.0445}, {"MEGS", 0.0134 - 0.059},
    };
    for (const auto& [name, height] : kHeights)
        if (model.size() >= 8 && model.substr(4, 4) == name) return height;
    return 0.0;
}

/// Weights of the IMU's latest samples, the newest first, that bring it to the instant and the bandwidth of force and torque: as
/// bota_ft_compensation/alignment.py, which explains them.
struct Alignment {
    using Taps = std::vector<double>;

    /// Force and torque are `lag_s` later than the accelerometer (none: unknown), the gyroscope `gyroscope_s`.
    Alignment(std::optional<double> lag_s, double gyroscope_s, bool fir, double rate_hz) : period_s(1.0 / rate_hz) {
        const double at_s = lag_s.value_or(0.0), late = std::max(at_s, 0.0) * rate_hz;
        const bool whole = fir && lag_s;  // the IMU passes the FIR filter, too
        lead = 1 + static_cast<int>(late) + (whole ? 2 : 0);
        gap_s = std::max(whole ? 0.015 : 0.008, 2.5 / rate_hz);
        const int count = static_cast<int>(std::ceil(late)) + (whole ? 13 : std::max(3, static_cast<int>(std::nearbyint(0.014 * rate_hz))));
        for (std::size_t band = 0; band < kBands; ++band) gains_[band] = lag_s ? gain(hertz(band) * period_s, whole) : 1.0;
        const double acceleration_noise = 250e-6 * kStandardGravity * std::sqrt(460.0), rate_noise = 0.01 * kPi / 180.0 * std::sqrt(184.0);
        const auto turned = [&](bool slope) { return fitted(4.0, 1.5, rate_noise, std::max(at_s - gyroscope_s, -kFurthest), count, slope); };
        lead = std::min(lead + std::max(1, static_cast<int>(std::ceil(0.004 * rate_hz))), count);
        taps = {lag_s ? fitted(10.0, 9.0, acceleration_noise, std::max(at_s, -kFurthest), count, false) : Taps{1.0}, turned(false), turned(true)};
    }

    double period_s, gap_s;  ///< samples further apart than `gap_s` do not belong together
    int lead;                      ///< this many samples are needed after a gap to tell the instant of force and torque
    std::array<Taps, 3> taps;      ///< to acceleration, angular rate and angular acceleration

private:
    static constexpr std::size_t kBands = 21;
    static constexpr double kFurthest = 0.002;  // s: extrapolation goes no further

    static double hertz(std::size_t band) { return 0.5 * std::pow(2.0, 0.5 * static_cast<double>(band)); }

    /// Of the sinc filter, and of the FIR filter (22 taps, Kaiser, beta 8.8), at this share of the rate.
    static double gain(double share, bool fir) {
        const auto bessel = [](double x) {  // modified, of order 0
            double sum = 0.0, term = 1.0;
            for (int k = 1; k <= 30; ++k) sum += term, term *= x * x / (4.0 * k * k);
            return sum;
        };
        double sum = 0.0, passed = 0.0;
        for (int k = 0; fir && k < 22; ++k) {
            const double x = (k - 10.5) / 10.5, tap = bessel(8.8 * std::sqrt(1.0 - x * x));
            sum += tap, passed += tap * std::cos(2.0 * kPi * share * (k - 10.5));
        }
        return std::pow(std::abs(std::sin(kPi * share) / (kPi * share)), 3) * (fir ? std::abs(passed / sum) : 1.0);
    }

    /// To the value `lag_s` before the newest sample, or the slope, of a motion with this density and noise.
    Taps fitted(double rms, double from_hz, double noise, double lag_s, int count, bool slope) const {
        const auto n = static_cast<std::size_t>(count);
        std::vector<Taps> rows(n + 2, Taps(n + 3));
        for (std::size_t band = 0; band < kBands; ++band) {
            const double hz = hertz(band), ratio = hz / from_hz, pace = 2.0 * kPi * hz;
            const double expected = rms * rms * 0.5 * std::log(2.0) * ratio / std::pow(1.0 + ratio * ratio, 3), seen = expected * gains_[band];
            for (std::size_t i = 0; i < n; ++i) {
                const double age_s = static_cast<double>(i) * period_s, late = pace * (age_s - lag_s);
                for (std::size_t j = 0; j < n; ++j) rows[i][j] += expected * std::cos(pace * (age_s - static_cast<double>(j) * period_s));
                rows[i][n + 2] += slope ? -seen * pace * std::sin(late) : seen * std::cos(late);
            }
        }
        for (std::size_t i = 0; i < n; ++i) {
            rows[i][i] += noise * noise;
            rows[i][n] = rows[n][i] = 1.0;
            rows[i][n + 1] = rows[n + 1][i] = static_cast<double>(i) * period_s;
        }
        rows[n][n + 2] = slope ? 0.0 : 1.0;
        rows[n + 1][n + 2] = slope ? -1.0 : lag_s;
        for (std::size_t k = 0; k < rows.size(); ++k) {  // Gauss and Jordan
            std::swap(rows[k], *std::max_element(rows.begin() + static_cast<std::ptrdiff_t>(k), rows.end(),
                                                 [k](const Taps& a, const Taps& b) { return std::abs(a[k]) < std::abs(b[k]); }));
            for (std::size_t i = 0; i < rows.size(); ++i)
                if (const double share = rows[i][k] / rows[k][k]; i != k)
                    for (std::size_t j = k; j < n + 3; ++j) rows[i][j] -= share * rows[k][j];
        }
        Taps found(n);
        for (std::size_t i = 0; i < n; ++i) found[i] = rows[i][n + 2] / rows[i][i];
        return found;
    }

    std::array<double, kBands> gains_{};
};

/// The load of the tool, of one sample after the other.
class Tool {
public:
    Tool(const Payload& payload, std::string_view model, Alignment alignment)
        : payload_(payload), alignment_(std::move(alignment)), lever_(payload.center) {
        lever_[2] -= imu_height(model);
        for (const auto& taps : alignment_.taps) count_ = std::max(count_, taps.size());
        ring_.resize(2 * count_);
    }

    /// N, Nm; NaN if acceleration or angular rate are not finite, the IMU is off, or the sensor moves, or did before a gap, and
    /// what was just before is not known. `time_s` is by a clock that nobody sets.
    Wrench follow(const bota_ethercat::Sample& sample, double time_s) {
        if (!sample.imu_is_finite()) time_s_ = kNever;
        if (!sample.imu_is_finite() || sample.acceleration == Vector3{}) return none();
        append(row(sample), time_s - time_s_);
        time_s_ = time_s;
        if (known_ < alignment_.lead && (moved_ || turns(ring_[at_])) && lever_ != Vector3{}) return none();
        const Vector3 omega = aligned(1, 3), alpha = aligned(2, 3), tangential = vector_product(alpha, lever_);
        const Vector3 centripetal = vector_product(omega, vector_product(omega, lever_)), s = aligned(0, 0);
        Vector3 force{};
        for (std::size_t i = 0; i < 3; ++i) force[i] = -payload_.mass * (s[i] + tangential[i] + centripetal[i]);
        Vector3 torque = vector_product(payload_.center, force);
        const Vector3 spun = inertia(alpha), turned = vector_product(omega, inertia(omega));
        for (std::size_t i = 0; i < 3; ++i) torque[i] -= spun[i] + turned[i];
        return {force[0], force[1], force[2], torque[0], torque[1], torque[2]};
    }

private:
    using Row = std::array<double, 6>;  // true acceleration, angular rate
    static constexpr double kNever = -1e18;  // s; infinity is nothing that -ffast-math knows

    static bool turns(const Row& row) noexcept {
        constexpr double kTurning = 0.05;  // rad/s: less is a gyroscope's offset
        return row[3] * row[3] + row[4] * row[4] + row[5] * row[5] > kTurning * kTurning;
    }

    static bool pushed(const Row& before, const Row& row) noexcept {
        constexpr double kPushed = 0.5;  // m/s²: less is an accelerometer's noise
        double square = 0.0;
        for (std::size_t i = 0; i < 3; ++i) square += (row[i] - before[i]) * (row[i] - before[i]);
        return square > kPushed * kPushed;
    }

    static Wrench none() noexcept { return {NAN, NAN, NAN, NAN, NAN, NAN}; }

    Vector3 inertia(const Vector3& v) const noexcept {
        const auto& [xx, yy, zz, xy, xz, yz] = payload_.inertia;
        return {xx * v[0] + xy * v[1] + xz * v[2], xy * v[0] + yy * v[1] + yz * v[2], xz * v[0] + yz * v[1] + zz * v[2]};
    }

    Row row(const bota_ethercat::Sample& sample) const noexcept {
        Vector3 a = sample.acceleration;
        for (std::size_t i = 0; i < 3; ++i) a[i] = (a[i] - payload_.accelerometer_offset[i]) / payload_.accelerometer_scale[i];
        const auto& [xy, xz, yx, yz, zx, zy] = payload_.accelerometer_cross_axis;
        const Vector3& w = sample.angular_rate;
        return {a[0] - xy * a[1] - xz * a[2], a[1] - yx * a[0] - yz * a[2], a[2] - zx * a[0] - zy * a[1], w[0], w[1], w[2]};
    }

    /// Append a sample that comes `passed_s` after the one before, and interpolate those that are missing between them.
    void append(const Row& row, double passed_s) {
        if (!(passed_s > 0.0 && passed_s <= alignment_.gap_s)) {
            const auto newest = ring_.begin() + static_cast<std::ptrdiff_t>(at_), end = newest + static_cast<std::ptrdiff_t>(count_);
            moved_ = known_ > 0 && (std::any_of(newest, end, turns) || pushed(*newest, row));
            ring_.assign(2 * count_, row);
            known_ = 1;
            return;
        }
        const int periods = static_cast<int>(std::nearbyint(passed_s / alignment_.period_s)), before_it = known_;
        const Row before = ring_[at_];
        for (int lost = 1; lost < periods; ++lost) {
            Row between = row;
            for (std::size_t i = 0; i < 6; ++i) between[i] = before[i] + (row[i] - before[i]) * lost / periods;
            push(between);
        }
        push(row);
        known_ += std::max(periods, 1);
        if (before_it < alignment_.lead && known_ >= alignment_.lead) continue_back();
    }

    void push(const Row& row) noexcept {
        at_ = (at_ == 0 ? count_ : at_) - 1;
        ring_[at_] = ring_[at_ + count_] = row;
    }

    /// What precedes the samples since a gap, on the line through them.
    void continue_back() noexcept {
        const std::size_t known = std::min(static_cast<std::size_t>(known_), count_);
        const double middle = 0.5 * static_cast<double>(known - 1), squares = static_cast<double>(known * (known * known - 1)) / 12.0;
        Row mean{}, slope{};  // of the slope the sign is that of greater ages
        for (std::size_t k = 0; k < known; ++k)
            for (std::size_t i = 0; i < 6; ++i) {
                mean[i] += ring_[at_ + k][i] / static_cast<double>(known);
                slope[i] += ring_[at_ + k][i] * (static_cast<double>(k) - middle) / squares;
            }
        for (std::size_t k = known; k < count_; ++k) {
            Row& then = ring_[(at_ + k) % count_];
            for (std::size_t i = 0; i < 6; ++i) then[i] = mean[i] + slope[i] * (static_cast<double>(k) - middle);
            ring_[(at_ + k) % count_ + count_] = then;
        }
    }

    /// Three of the columns from `first` on, with these weights.
    Vector3 aligned(std::size_t taps, std::size_t first) const noexcept {
        Vector3 sum{};
        for (std::size_t k = 0; k < alignment_.taps[taps].size(); ++k)
            for (std::size_t i = 0; i < 3; ++i) sum[i] += alignment_.taps[taps][k] * ring_[at_ + k][first + i];
        return sum;
    }

    Payload payload_;
    Alignment alignment_;
    Vector3 lever_;            // from the IMU to the center of gravity
    std::size_t count_ = 0;    // of the samples that are kept
    std::vector<Row> ring_;    // twice, from `at_` on the newest first
    std::size_t at_ = 0;
    int known_ = 0;            // since the last gap
    bool moved_ = false;       // before it, or in it
    double time_s_ = kNever;
};

}  // namespace bota_ethercat_hardware
