// Which sensor it is and how it is set, as the server describes it; what speaks against using it.
#pragma once

#include <algorithm>
#include <cstdint>
#include <cstdio>
#include <optional>
#include <string>

#include <bota_ethercat.hpp>

#include "bota_ethercat_hardware/parameters.hpp"

namespace bota_ethercat_hardware {

struct Identity {
    std::string name;
    std::uint64_t serial = 0;
    std::uint32_t pdo_size = 0;  // bytes of process data
    double rate_hz = 0.0;        // 0: not known
    // What the numbers mean depends on these. None: the server does not say.
    std::optional<bool> calibration_matrix, coordinate_system, inertia_compensation, orientation_estimation;
    std::optional<int> imu_active;
};

namespace detail {

template <typename Number>
void get(bota_ethercat::json::Value value, std::optional<Number>& into) {
    Number found{};
    into = value.get(found) ? std::optional<Number>(found) : std::nullopt;
}

inline std::string text(double number, const char* format = "%.4g") {
    char digits[32];
    const int length = std::snprintf(digits, sizeof digits, format, number);
    for (int i = 0; i < length; ++i)
        if (digits[i] == ',') digits[i] = '.';  // whatever the locale
    return digits;
}

inline std::string named(const Identity& sensor) { return sensor.name + ", serial " + std::to_string(sensor.serial); }

}  // namespace detail

/// The sensor at this position in the reply to `describe`; false if there is none.
inline bool find(bota_ethercat::json::Value reply, std::uint8_t position, Identity& into) {
    bota_ethercat::json::Value each;
    for (bota_ethercat::json::Items items(reply["sensors"]); items.next(each);) {
        int sensor = -1;
        if (!each["sensor"].get(sensor) || sensor != position) continue;
        bota_ethercat::Text<32> name;
        each["name"].get(name);
        into.name = name.c_str();
        each["serial"].get(into.serial);
        each["pdo_size"].get(into.pdo_size);
        if (!each["rate_hz"].get(into.rate_hz) || !(into.rate_hz > 0.0 && into.rate_hz < 1e6)) into.rate_hz = 0.0;
        const bota_ethercat::json::Value settings = each["settings"];
        detail::get(settings["calibration_matrix"], into.calibration_matrix);
        detail::get(settings["coordinate_system"], into.coordinate_system);
        detail::get(settings["inertia_compensation"], into.inertia_compensation);
        detail::get(settings["orientation_estimation"], into.orientation_estimation);
        detail::get(settings["imu_active"], into.imu_active);
        return true;
    }
    return false;
}

/// s up to which a sample of this sensor is fresh.
inline double max_age(const Parameters& parameters, const Identity& sensor) {
    return parameters.max_age.value_or(std::max(0.01, sensor.rate_hz > 0.0 ? 4.0 / sensor.rate_hz : 0.0));
}

/// Why this sensor, set like this, cannot give what the URDF asks for; empty if it can.
inline std::string objection(const Parameters& parameters, const Identity& sensor) {
    using detail::text;
    if (parameters.serial && *parameters.serial != sensor.serial)
        return "is " + detail::named(sensor) + ", but the parameter serial is " + std::to_string(*parameters.serial);
    if (sensor.calibration_matrix == false)
        return "sends ADC counts instead of N and Nm: switch its setting calibration_matrix on";
    if (sensor.rate_hz > 0.0 && max_age(parameters, sensor) * sensor.rate_hz < 2.0)
        return "has a sample every " + text(1.0 / sensor.rate_hz) + " s: raise max_age (" + text(*parameters.max_age) +
               " s) to at least " + text(2.0 / sensor.rate_hz);
    if (parameters.wants_imu && sensor.imu_active == 0)
        return "has its IMU switched off: set imu_active to 1, or leave linear_acceleration and angular_velocity out of the URDF";
    if (parameters.wants_orientation && sensor.pdo_size == bota_ethercat::kPdoSize)
        return "does not map its orientation (61 bytes of process data): leave orientation out of the URDF";
    if (parameters.wants_orientation && sensor.orientation_estimation == false)
        return "does not estimate its orientation: switch its setting orientation_estimation on";
    return {};
}

/// What makes a sensor another one than that of on_configure, or its numbers mean something else; empty if nothing does.
inline std::string difference(const Identity& before, const Identity& now) {
    if (before.serial != now.serial) return "is " + detail::named(now) + ", and was " + detail::named(before) + ", when configured";
    const auto changed = [](const std::optional<bool>& a, const std::optional<bool>& b) { return a && b && a != b; };
    const char* const setting = changed(before.coordinate_system, now.coordinate_system)          ? "coordinate_system"
                                : changed(before.inertia_compensation, now.inertia_compensation) ? "inertia_compensation"
                                                                                                 : nullptr;
    if (setting) return std::string("has another ") + setting + " than when configured: change it back, or clean up and configure again";
    return {};
}

}  // namespace bota_ethercat_hardware
