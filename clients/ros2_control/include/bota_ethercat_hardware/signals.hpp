// The state interfaces: their names, what of a sample they are, and their units.
#pragma once

#include <array>
#include <cstddef>
#include <limits>
#include <string_view>

#include <bota_ethercat.hpp>

namespace bota_ethercat_hardware {

/// In this order they are in `Values`. Force N, torque Nm, acceleration m/s^2 (+g along the axis that points up),
/// angular velocity rad/s, orientation x y z w, temperature degrees Celsius, age s, condition a `bota_ethercat::Condition`.
inline constexpr std::array<std::string_view, 19> kSignals = {
    "force.x",       "force.y",       "force.z",       "torque.x",
    "torque.y",      "torque.z",      "linear_acceleration.x", "linear_acceleration.y",
    "linear_acceleration.z", "angular_velocity.x", "angular_velocity.y", "angular_velocity.z",
    "orientation.x", "orientation.y", "orientation.z", "orientation.w",
    "temperature",   "age",           "condition",
};
inline constexpr std::size_t kImu = 6, kOrientation = 12, kTemperature = 16, kMeasured = 17, kAge = 17, kCondition = 18;

using Values = std::array<double, kSignals.size()>;

inline constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();

/// The place of a state interface in `Values`; their number if there is none of that name.
constexpr std::size_t signal(std::string_view name) noexcept {
    std::size_t i = 0;
    while (i < kSignals.size() && kSignals[i] != name) ++i;
    return i;
}

/// All that is measured; `age` and `condition` stay as they are.
inline void fill(const bota_ethercat::Sample& sample, Values& values) noexcept {
    const auto twelve = sample.array();
    for (std::size_t i = 0; i < twelve.size(); ++i) values[i] = twelve[i];
    for (std::size_t i = 0; i < sample.orientation.size(); ++i)
        values[kOrientation + i] = sample.has_orientation ? sample.orientation[i] : kNaN;
    values[kTemperature] = sample.temperature;
}

/// The same, with NaN.
inline void fill_nan(Values& values) noexcept {
    for (std::size_t i = 0; i < kMeasured; ++i) values[i] = kNaN;
}

}  // namespace bota_ethercat_hardware
