// Weight and inertia of the tool, to be subtracted from force and torque (docs/compensation.md):
//
//     tool force = -m s, tool torque = c x tool force,  s = s_imu + alpha x d + omega x (omega x d)
//
// s: specific force (acceleration minus gravity) at the center of gravity c, d from the IMU to c; brought to the instant of
// force and torque first. As ros2_bridge/ft_compensation, to which the tests hold it: specific_force, alignment, compensator.
#pragma once

#include <array>
#include <cmath>
#include <deque>
#include <string_view>
#include <utility>
#include <vector>

#include <bota_ethercat.hpp>

namespace bota_ethercat_hardware {

using bota_ethercat::Vector3;
using Wrench = std::array<double, 6>;  // Fx Fy Fz (N) Mx My Mz (Nm), about the wrench origin

/// What hangs on the sensor's tool side, and what its accelerometer reads: `scale` times the truth plus `offset`, per axis.
struct Payload {
    double mass = 0.0;  ///< kg
    Vector3 center{};   ///< of gravity, m from the wrench origin
    Vector3 accelerometer_offset{}, accelerometer_scale{1, 1, 1};  ///< m/s^2, none
};

inline Vector3 cross(const Vector3& a, const Vector3& b) noexcept {
    return {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]};
}

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

/// The weights of the newest specific force and those before it, for a force that is `lag` sample periods later: with the
/// sensor's FIR filter on its window (22 taps, Kaiser, beta 8.8), else between two samples. {1} if the force is not later.
inline std::vector<double> alignment_taps(double lag, bool fir) {
    constexpr double kNegligible = 0.1, kHalf = 10.5, kBeta = 8.8;
    const auto bessel = [](double x) {  // modified, of order 0
        double sum = 0.0, term = 1.0;
        for (int k = 1; k <= 30; ++k) sum += term, term *= x * x / (4.0 * k * k);
        return sum;
    };
    if (!(lag >= kNegligible)) return {1.0};
    std::vector<double> taps(static_cast<std::size_t>(lag + (fir ? kHalf : 1.0)) + 1);
    double sum = 0.0;
    for (std::size_t k = 0; k < taps.size(); ++k) {
        const double off = std::abs(static_cast<double>(k) - lag), x = off / kHalf;
        if (fir) taps[k] = x <= 1.0 ? bessel(kBeta * std::sqrt(1.0 - x * x)) : 0.0;
        else taps[k] = off < 1.0 ? 1.0 - off : 0.0;
        sum += taps[k];
    }
    for (double& tap : taps) tap /= sum;
    return taps;
}

/// The load of the tool, of one sample after the other.
class Tool {
public:
    /// `lag_s`: by how much force and torque are later than the accelerometer; `rate_hz` of the samples.
    Tool(const Payload& payload, std::string_view model, double lag_s, bool fir, double rate_hz)
        : payload_(payload), taps_(alignment_taps(lag_s * rate_hz, fir)), rate_hz_(rate_hz), lever_(payload.center) {
        lever_[2] -= imu_height(model);
    }

    /// N, Nm; NaN if acceleration or angular rate are not finite, or the IMU is off. `time_s` is by a clock that nobody sets.
    Wrench follow(const bota_ethercat::Sample& sample, double time_s) {
        const Vector3& rate = sample.angular_rate;
        if (!sample.imu_is_finite()) rates_.clear();
        if (!sample.imu_is_finite() || sample.acceleration == Vector3{}) return {NAN, NAN, NAN, NAN, NAN, NAN};
        Vector3 s = sample.acceleration;
        for (std::size_t i = 0; i < 3; ++i) s[i] = (s[i] - payload_.accelerometer_offset[i]) / payload_.accelerometer_scale[i];
        const Vector3 tangential = cross(slope(rate, time_s), lever_), centripetal = cross(rate, cross(rate, lever_));
        for (std::size_t i = 0; i < 3; ++i) s[i] += tangential[i] + centripetal[i];
        Vector3 force = aligned(s, time_s);
        for (double& each : force) each *= -payload_.mass;
        const Vector3 torque = cross(payload_.center, force);
        return {force[0], force[1], force[2], torque[0], torque[1], torque[2]};
    }

private:
    /// Angular acceleration, rad/s^2: the slope of the angular rate over 5 ms, and so half of that late. Zero until there is one.
    Vector3 slope(const Vector3& rate, double time_s) {
        constexpr double kSlopeS = 0.005, kGapS = 0.1;
        const double passed_s = rates_.empty() ? 0.0 : time_s - rates_.back().first;
        if (!(0.0 < passed_s && passed_s <= kGapS)) rates_.clear();
        rates_.emplace_back(time_s, rate);
        while (rates_.size() > 2 && time_s - rates_[1].first >= kSlopeS) rates_.pop_front();
        if (rates_.size() < 2) return {};
        Vector3 result = rate;
        for (std::size_t i = 0; i < 3; ++i) result[i] = (rate[i] - rates_[0].second[i]) / (time_s - rates_[0].first);
        return result;
    }

    /// `s` as it was when force and torque of this sample were. A value stands for up to four samples that were lost after it.
    Vector3 aligned(const Vector3& s, double time_s) {
        if (taps_.size() == 1) return s;
        const double lost = std::nearbyint((time_s - time_s_) * rate_hz_) - 1.0;
        if (!(lost >= 0.0 && lost <= 4.0)) history_.clear();
        for (double left = history_.empty() ? 0.0 : lost; left >= 0.0; --left) history_.push_front(s);
        if (history_.size() > taps_.size()) history_.resize(taps_.size());
        time_s_ = time_s;
        Vector3 sum{};
        double weight = 0.0;
        for (std::size_t k = 0; k < history_.size(); weight += taps_[k++])
            for (std::size_t i = 0; i < 3; ++i) sum[i] += taps_[k] * history_[k][i];
        if (!(weight > 0.0)) return s;
        for (double& each : sum) each /= weight;
        return sum;
    }

    Payload payload_;
    std::vector<double> taps_;
    double rate_hz_, time_s_ = 0.0;
    Vector3 lever_;                                  // from the IMU to the center of gravity
    std::deque<std::pair<double, Vector3>> rates_;   // with their times, the oldest first
    std::deque<Vector3> history_;                    // the newest first
};

}  // namespace bota_ethercat_hardware
