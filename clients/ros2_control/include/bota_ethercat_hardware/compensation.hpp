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
    std::array<double, 9> gyroscope{1, 0, 0, 0, 1, 0, 0, 0, 1};  ///< angular rates are this, row by row, times what is read
    Vector3 imu_position{};  ///< m from the wrench origin; zeros: that of the model
    std::array<double, 6> noise{}, left{};  ///< as Accuracy of bota_ft_compensation/quantities.py
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
        whole = fir && lag_s;
        lead = 1 + static_cast<int>(late) + (whole ? 2 : 0);
        gap_s = std::max(whole ? 0.015 : 0.008, 2.5 / rate_hz);
        const auto counted = [&](double history_s) {
            return static_cast<int>(std::ceil(late)) + (whole ? 13 : std::max(3, static_cast<int>(std::nearbyint(history_s * rate_hz))));
        };
        const int count = counted(0.025);
        for (std::size_t band = 0; band < kBands; ++band) gains_[band] = lag_s ? gain(hertz(band) * period_s, whole) : 1.0;
        const double acceleration_noise = 250e-6 * kStandardGravity * std::sqrt(460.0), rate_noise = 0.01 * kPi / 180.0 * std::sqrt(184.0);
        const auto turned = [&](bool slope) { return fitted(6.0, 8.0, 8, rate_noise, std::max(at_s - gyroscope_s, -kFurthest), count, slope); };
        lead = std::min(lead + std::max(1, static_cast<int>(std::ceil(0.004 * rate_hz))), count);
        taps = {lag_s ? fitted(10.0, 9.0, 3, acceleration_noise, std::max(at_s, -kFurthest), counted(0.014), false) : Taps{1.0}, turned(false), turned(true)};
        felt_noise = acceleration_noise * norm(taps[0]), spin_noise = rate_noise * norm(taps[2]), spin_error = fir ? 0.0 : 0.006;
        tare_noise = acceleration_noise * std::sqrt(period_s);
        Taps passed{1.0};
        if (fir) passed = fir_taps();
        for (std::size_t i = 0; i < 2; ++i) noise_ratios[i] = norm(passed) * std::pow(51200.0 / rate_hz / 51.0, i == 0 ? -0.62 : -0.78);
    }

    double period_s, gap_s;  ///< samples further apart than `gap_s` do not belong together
    bool whole;                    ///< the IMU passes the FIR filter, too, and so do products of its rates
    int lead;                      ///< this many samples are needed after a gap to tell the instant of force and torque
    std::array<Taps, 3> taps;      ///< to acceleration, angular rate and angular acceleration
    double felt_noise, spin_noise;           ///< deviations that the IMU's noise makes on each axis, m/s^2 and rad/s^2
    double tare_noise;                       ///< as `felt_noise`, of the mean of a second
    double spin_error;                       ///< what this leaves of angular accelerations, as a share of them
    std::array<double, 2> noise_ratios{};    ///< of force and of torque, to those at SINC 51 with FIR off

private:
    static constexpr std::size_t kBands = 21;
    static constexpr double kFurthest = 0.002;  // s: extrapolation goes no further

    static double hertz(std::size_t band) { return 0.5 * std::pow(2.0, 0.5 * static_cast<double>(band)); }

    static double norm(const Taps& taps) {
        double squares = 0.0;
        for (const double tap : taps) squares += tap * tap;
        return std::sqrt(squares);
    }

    /// Of the FIR filter: 22 taps, Kaiser, beta 8.8.
    static Taps fir_taps() {
        Taps taps(22);
        double all = 0.0;
        for (std::size_t n = 0; n < taps.size(); ++n) {
            const double x = (static_cast<double>(n) - 10.5) / 10.5, z = 8.8 * 8.8 * (1.0 - x * x);
            double term = 1.0;  // the modified Bessel function of order 0
            for (int k = 1; k <= 30; ++k) taps[n] += term, term *= z / (4.0 * k * k);
            all += taps[n];
        }
        for (double& tap : taps) tap /= all;
        return taps;
    }

    /// Of the sinc filter, and of the FIR filter, at this share of the rate.
    static double gain(double share, bool fir) {
        double passed = fir ? 0.0 : 1.0, late = -10.5;
        if (fir)
            for (const double tap : fir_taps()) passed += tap * std::cos(2.0 * kPi * share * late++);
        return std::pow(std::abs(std::sin(kPi * share) / (kPi * share)), 3) * std::abs(passed);
    }

    /// To the value `lag_s` before the newest sample, or the slope, of a motion with this density and noise.
    Taps fitted(double rms, double from_hz, int steepness, double noise, double lag_s, int count, bool slope) const {
        const auto n = static_cast<std::size_t>(count);
        std::vector<Taps> rows(n + 2, Taps(n + 3));
        for (std::size_t band = 0; band < kBands; ++band) {
            const double hz = hertz(band), ratio = hz / from_hz, pace = 2.0 * kPi * hz;
            const double expected = rms * rms * 0.5 * std::log(2.0) * ratio / std::pow(1.0 + ratio * ratio, steepness), seen = expected * gains_[band];
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

/// How wrong the compensated wrench may be without contact, in 95 % of samples: as bota_ft_compensation/bounds.py, which explains it.
/// The IMU's filters are those that sensors are delivered with.
class Bounds {
public:
    /// `lever`: from the IMU to the center of gravity. The bias is of a tare, in which this specific force was felt (none: not known).
    Bounds(const Payload& tool, const Vector3& lever, const Alignment& alignment, bool tared, const std::optional<Vector3>& at = {})
        : tared_(tared), from_(at) {
        constexpr double kPlace = 1.3e-3, kSpin = 0.013, kAlone = 1.15, kNormal = 1.96;
        const auto& [xx, yy, zz, xy, xz, yz] = tool.inertia;
        const std::array<Vector3, 3> tensor{{{xx, xy, xz}, {xy, yy, yz}, {xz, yz, zz}}};
        const double mass = tool.mass, weight = square(mass / kNormal), at_arm = 2.0 / 3.0 * sum(tool.center), levers = sum(lever);
        const double arm = mass * bota_ethercat::detail::dot(tool.center, lever), tare_noise = tared ? alignment.tare_noise : 0.0;
        const double felt = 3.0 * mass * mass * (square(alignment.felt_noise) + square(tare_noise));
        Vector3 forces{}, torques{};  // squared, of an angular acceleration about each axis
        for (std::size_t i = 0; i < 3; ++i) {
            forces[i] = mass * mass * (levers - square(lever[i]));
            for (std::size_t j = 0; j < 3; ++j) torques[i] += square((i == j ? arm : 0.0) - mass * lever[j] * tool.center[i] + tensor[i][j]);
        }
        const auto noise = [&](std::size_t i) { return square((tool.noise[i] > 0.0 ? tool.noise : kHealthy)[i] * alignment.noise_ratios[i / 3]); };
        const double spin = square(alignment.spin_noise);
        fixed_[0] = felt + (forces[0] + forces[1] + forces[2]) * spin + noise(0) + noise(1) + noise(2);
        fixed_[1] = at_arm * felt + (torques[0] + torques[1] + torques[2]) * spin + noise(3) + noise(4) + noise(5);
        double wrong = square(alignment.spin_error);
        if (tool.left != decltype(tool.left){}) {
            for (std::size_t part = 0; part < 2; ++part) {
                const auto left = [&](std::size_t i) { return 3.0 * square(tool.left[3 * part + i]); };
                if (!tared) fixed_[part] += left(0);
                by_felt_[part].fill(tared ? left(1) : 0.0);
                by_spin_[part].fill(left(2));
            }
        } else {
            const auto& [c_xy, c_xz, c_yx, c_yz, c_zx, c_zy] = tool.cross_axis_interval;
            const std::array<std::array<double, 2>, 3> columns{{{c_yx, c_zx}, {c_xy, c_zy}, {c_xz, c_yz}}};
            const double offset = tared ? 0.0 : weight * sum(tool.offset_interval), off = 2.0 * kAlone * square(mass * kPlace);
            fixed_[0] += offset, fixed_[1] += at_arm * offset, wrong = kAlone * (wrong + square(kSpin));
            const auto halves = inertia_halves(tool);
            const std::array<Vector3, 3> elements{{{halves[0], halves[3], halves[4]}, {halves[3], halves[1], halves[5]}, {halves[4], halves[5], halves[2]}}};
            for (std::size_t i = 0; i < 3; ++i) {
                by_felt_[0][i] = weight * (square(tool.scale_interval[i]) + square(columns[i][0]) + square(columns[i][1]));
                const double centers = kAlone * weight * (sum(tool.center_interval) - square(tool.center_interval[i]));
                by_felt_[1][i] = centers + at_arm * by_felt_[0][i], by_spin_[0][i] = off + centers;
                by_spin_[1][i] = sum(elements[i]) / square(kNormal) + at_arm * by_spin_[0][i];
            }
        }
        for (std::size_t i = 0; i < 3; ++i) {
            by_spin_[0][i] += wrong * forces[i], by_spin_[1][i] += wrong * torques[i];
            for (std::size_t part = 0; part < 2; ++part) still_[part] -= spin * by_spin_[part][i];
        }
    }

    /// N, Nm. `felt`, m/s^2, at the center of gravity; `rate`, rad/s; `spin`, rad/s^2.
    std::array<double, 2> at(const Vector3& felt, const Vector3& rate, const Vector3& spin) const noexcept {
        std::array<double, 2> found = fixed_, spun = still_;
        const double quarter = 0.25 * sum(rate);
        for (std::size_t i = 0; i < 3; ++i) {
            const double less = tared_ && from_ ? (*from_)[i] : 0.0, turned = square(spin[i]) + quarter * square(rate[i]);
            const double moved = tared_ && !from_ ? 2.0 / 3.0 * square(kStandardGravity) : square(felt[i] - less);
            for (std::size_t part = 0; part < 2; ++part) found[part] += by_felt_[part][i] * moved, spun[part] += by_spin_[part][i] * turned;
        }
        return {std::sqrt(7.815 / 3.0 * (found[0] + std::max(spun[0], 0.0))), std::sqrt(2.8 * (found[1] + std::max(spun[1], 0.0)))};
    }

private:
    static constexpr std::array<double, 6> kHealthy{0.3, 0.3, 0.3, 0.007, 0.007, 0.0025};  // N, Nm, at SINC 51

    static double square(double x) noexcept { return x * x; }
    static double sum(const Vector3& v) noexcept { return v[0] * v[0] + v[1] * v[1] + v[2] * v[2]; }

    static std::array<double, 6> inertia_halves(const Payload& tool) {
        auto halves = tool.inertia_interval;
        if (halves != decltype(halves){}) return halves;
        const double moment = *std::max_element(tool.inertia.begin(), tool.inertia.end()), reach = tool.mass * (0.01 + sum(tool.center));
        halves.fill(0.1 * moment);
        const double about = std::hypot(1.96 * 0.2, 0.45) * reach, across = 0.2 * reach;
        return tool.inertia != decltype(tool.inertia){} ? halves : decltype(halves){about, about, about, across, across, across};
    }

    bool tared_;
    std::optional<Vector3> from_;
    std::array<double, 2> fixed_{}, still_{};  // N^2, Nm^2
    std::array<Vector3, 2> by_felt_{}, by_spin_{};
};

/// The load of the tool, of one sample after the other.
class Tool {
public:
    Tool(const Payload& payload, std::string_view model, Alignment alignment)
        : payload_(payload), alignment_(std::move(alignment)), lever_(payload.center) {
        if (payload_.imu_position == Vector3{}) payload_.imu_position[2] = imu_height(model);
        for (std::size_t i = 0; i < 3; ++i) lever_[i] -= payload_.imu_position[i];
        for (const auto& taps : alignment_.taps) count_ = std::max(count_, taps.size());
        ring_.resize(2 * count_);
    }

    /// N, Nm; NaN if acceleration or angular rate are not finite, the IMU is off, or the sensor moves, or did before a gap, and
    /// what was just before is not known. `time_s` is by a clock that nobody sets.
    Wrench follow(const bota_ethercat::Sample& sample, double time_s) {
        if (!sample.imu_is_finite()) time_s_ = kNever;
        if (!sample.imu_is_finite() || sample.acceleration == Vector3{}) return none();
        const Vector3 &a = sample.acceleration, &w = sample.angular_rate;
        Row row{a[0], a[1], a[2], w[0], w[1], w[2]};
        if (alignment_.whole) {
            const Products own = products(turning(w));
            std::copy(own.begin(), own.end(), row.begin() + 6);
        }
        append(row, time_s - time_s_);
        time_s_ = time_s;
        if (known_ < alignment_.lead && (moved_ || turns(ring_[at_])) && lever_ != Vector3{}) return none();
        const auto [s, omega, alpha] = aligned();
        const auto [wxx, wyy, wzz, wxy, wxz, wyz] = alignment_.whole ? aligned_products() : products(omega);
        const auto& [x, y, z] = lever_;
        const auto& [xx, yy, zz, xy, xz, yz] = payload_.inertia;
        const Vector3 tangential = vector_product(alpha, lever_);
        const Vector3 centripetal{wxy * y + wxz * z - (wyy + wzz) * x, wxy * x + wyz * z - (wxx + wzz) * y, wxz * x + wyz * y - (wxx + wyy) * z};
        Vector3 force{};
        for (std::size_t i = 0; i < 3; ++i) force[i] = -payload_.mass * (s[i] + tangential[i] + centripetal[i]);
        Vector3 torque = vector_product(payload_.center, force);
        const Vector3 spun{xx * alpha[0] + xy * alpha[1] + xz * alpha[2], xy * alpha[0] + yy * alpha[1] + yz * alpha[2],
                           xz * alpha[0] + yz * alpha[1] + zz * alpha[2]};
        const Vector3 turned{xz * wxy - xy * wxz + yz * (wyy - wzz) + (zz - yy) * wyz, xy * wyz - yz * wxy + xz * (wzz - wxx) + (xx - zz) * wxz,
                             yz * wxz - xz * wyz + xy * (wxx - wyy) + (yy - xx) * wxy};
        for (std::size_t i = 0; i < 3; ++i) torque[i] -= spun[i] + turned[i];
        return {force[0], force[1], force[2], torque[0], torque[1], torque[2]};
    }

    /// As there; of samples that come.
    Bounds bounds(bool tared, const std::optional<Vector3>& at = {}) const { return {payload_, lever_, alignment_, tared, at}; }

private:
    // Acceleration and angular rate as read, corrected once aligned, which is linear; and products of rates, if they are aligned.
    using Row = std::array<double, 12>;
    using Products = std::array<double, 6>;  // of angular rates: xx yy zz xy xz yz
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

    static Products products(const Vector3& w) noexcept {
        return {w[0] * w[0], w[1] * w[1], w[2] * w[2], w[0] * w[1], w[0] * w[2], w[1] * w[2]};
    }

    Products aligned_products() const noexcept {
        Products found{};
        for (std::size_t k = 0; k < alignment_.taps[1].size(); ++k)
            for (std::size_t i = 0; i < found.size(); ++i) found[i] += alignment_.taps[1][k] * ring_[at_ + k][6 + i];
        return found;
    }

    Vector3 corrected(Vector3 a) const noexcept {
        for (std::size_t i = 0; i < 3; ++i) a[i] = (a[i] - payload_.accelerometer_offset[i]) / payload_.accelerometer_scale[i];
        const auto& [xy, xz, yx, yz, zx, zy] = payload_.accelerometer_cross_axis;
        return {a[0] - xy * a[1] - xz * a[2], a[1] - yx * a[0] - yz * a[2], a[2] - zx * a[0] - zy * a[1]};
    }

    Vector3 turning(const Vector3& w) const noexcept {
        const auto& g = payload_.gyroscope;
        const auto about = [&](std::size_t i) { return g[i] * w[0] + g[i + 1] * w[1] + g[i + 2] * w[2]; };
        return {about(0), about(3), about(6)};
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
            for (std::size_t i = 0; i < row.size(); ++i) between[i] = before[i] + (row[i] - before[i]) * lost / periods;
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
            for (std::size_t i = 0; i < slope.size(); ++i) {
                mean[i] += ring_[at_ + k][i] / static_cast<double>(known);
                slope[i] += ring_[at_ + k][i] * (static_cast<double>(k) - middle) / squares;
            }
        for (std::size_t k = known; k < count_; ++k) {
            Row& then = ring_[(at_ + k) % count_];
            for (std::size_t i = 0; i < slope.size(); ++i) then[i] = mean[i] + slope[i] * (static_cast<double>(k) - middle);
            ring_[(at_ + k) % count_ + count_] = then;
        }
    }

    /// Acceleration, angular rate and angular acceleration at the instant of force and torque.
    std::array<Vector3, 3> aligned() const noexcept {
        Vector3 s{}, omega{}, alpha{};
        const auto& [value, rate, slope] = alignment_.taps;
        const Row* row = &ring_[at_];
        for (std::size_t k = 0; k < value.size(); ++k)
            for (std::size_t i = 0; i < 3; ++i) s[i] += value[k] * row[k][i];
        for (std::size_t k = 0; k < rate.size(); ++k)
            for (std::size_t i = 0; i < 3; ++i) omega[i] += rate[k] * row[k][3 + i], alpha[i] += slope[k] * row[k][3 + i];
        return {corrected(s), turning(omega), turning(alpha)};
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
