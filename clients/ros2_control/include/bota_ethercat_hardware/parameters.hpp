// SPDX-License-Identifier: Apache-2.0
// The parameters of a <hardware> tag: one table of names, defaults and what is allowed. Wrong ones are refused in a sentence.
#pragma once

#include <algorithm>
#include <charconv>
#include <cstdint>
#include <fstream>
#include <limits>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include <bota_ethercat.hpp>

#include "bota_ethercat_hardware/compensation.hpp"

namespace bota_ethercat_hardware {

/// What controllers see while there is no sample to act on.
enum class Reaction : std::uint8_t {
    error,  ///< read() fails at once: the controller manager stops the controllers of this sensor
    nan,    ///< NaN, and an error after `error_after`
    hold,   ///< the last usable sample, and an error after `error_after`
    use,    ///< the sample as it is
};

inline constexpr const char* kReactions[] = {"error", "nan", "hold", "use"};
constexpr const char* name(Reaction reaction) noexcept { return kReactions[static_cast<int>(reaction)]; }

struct Parameters {
    bota_ethercat::Options client{"localhost", 12001, {0}};  ///< host, port, the position on the bus, and imu_units
    std::optional<std::uint32_t> serial;     ///< another sensor at that position is refused
    std::optional<double> max_age;           ///< s; none: four sample periods, at least 0.01
    Reaction on_stale = Reaction::nan;       ///< no sample younger than `max_age`
    Reaction on_saturated = Reaction::nan;   ///< the newest sample is saturated
    Reaction on_invalid = Reaction::nan;     ///< what comes cannot be trusted
    double error_after = 0.5;                ///< s of nan or hold until read() fails; infinity: never
    double connect_timeout = 5.0;            ///< s that on_configure waits for the server
    bool on_activate_tare = false;
    int receive_priority = 51;               ///< SCHED_FIFO, of the receiving thread, above a controller manager's 50; 0: none
    bool has_payload = false;                ///< then `payload` is known, and the compensated wrench
    Payload payload;
    Wrench bias{};                           ///< subtracted from the compensated wrench until the sensor is tared
    std::optional<Wrench> sensor_offset;     ///< the sensor's own, which goes with `bias`; none: that when configured
    // From the <sensor> tags, or as the payload needs it:
    bool wants_imu = false, wants_orientation = false, wants_compensated = false;

    std::uint8_t sensor() const noexcept { return client.sensors.front(); }
};

namespace detail {

inline std::string_view stripped(std::string_view text) noexcept {
    constexpr std::string_view kBlanks = " \t\r\n";
    const std::size_t from = std::min(text.find_first_not_of(kBlanks), text.size());
    return text.substr(from, text.find_last_not_of(kBlanks) + 1 - from);
}

/// A number, the whole of the text and nothing else, whatever the locale.
template <typename Number>
bool number(std::string_view text, Number least, Number most, Number& into) noexcept {
    Number found{};
    const auto done = std::from_chars(text.data(), text.data() + text.size(), found);
    if (done.ec != std::errc() || done.ptr != text.data() + text.size()) return false;
    if (bota_ethercat::is_nan(static_cast<double>(found)) || found < least || found > most) return false;
    into = found;
    return true;
}

/// As many numbers as `into` has, with blanks or commas between them, in brackets or not.
template <std::size_t Size>
bool numbers(std::string_view text, std::array<double, Size>& into, double least = -1e6) noexcept {
    constexpr std::string_view kBetween = " \t\r\n,[]";
    std::size_t count = 0;
    for (std::size_t at = 0; (at = text.find_first_not_of(kBetween, at)) != text.npos; ++count) {
        const std::size_t end = std::min(text.find_first_of(kBetween, at), text.size());
        if (count == Size || !number(text.substr(at, end - at), least, 1e6, into[count])) return false;
        at = end;
    }
    return count == Size;
}

inline bool reaction(std::string_view text, Reaction most, Reaction& into) noexcept {
    const auto found = static_cast<Reaction>(std::find(std::begin(kReactions), std::end(kReactions), text) - kReactions);
    return found <= most && (into = found, true);
}

struct Row {
    const char *name, *allowed;
    bool (*parse)(std::string_view text, Parameters& into);
};

bool read_payload(const std::string& path, Parameters& into);

using P = Parameters;
using S = std::string_view;
inline constexpr Row kRows[] = {
    {"host", "a host name or address", [](S t, P& p) { return !t.empty() && (p.client.host = t, true); }},
    {"port", "1 to 65535", [](S t, P& p) { return number<std::uint16_t>(t, 1, 65535, p.client.port); }},
    {"sensor", "a position on the bus, 0 to 255",
     [](S t, P& p) { return number<std::uint8_t>(t, 0, 255, p.client.sensors[0]); }},
    {"serial", "a serial number in decimal digits",
     [](S t, P& p) { return number<std::uint32_t>(t, 0, 0xFFFFFFFF, p.serial.emplace()); }},
    {"max_age", "0.001 to 10 (s)", [](S t, P& p) { return number(t, 0.001, 10.0, p.max_age.emplace()); }},
    {"on_stale", "error, nan or hold", [](S t, P& p) { return reaction(t, Reaction::hold, p.on_stale); }},
    {"on_saturated", "error, nan, hold or use", [](S t, P& p) { return reaction(t, Reaction::use, p.on_saturated); }},
    {"on_invalid", "error, nan or hold", [](S t, P& p) { return reaction(t, Reaction::hold, p.on_invalid); }},
    {"error_after", "0 or more (s), or inf for never",
     [](S t, P& p) { return number(t, 0.0, std::numeric_limits<double>::infinity(), p.error_after); }},
    {"connect_timeout", "0 to 600 (s)", [](S t, P& p) { return number(t, 0.0, 600.0, p.connect_timeout); }},
    {"on_activate_tare", "true or false", [](S t, P& p) {  // xacro writes them as Python does
         return p.on_activate_tare = t == "true" || t == "True", p.on_activate_tare || t == "false" || t == "False";
     }},
    {"receive_priority", "0 to 99", [](S t, P& p) { return number(t, 0, 99, p.receive_priority); }},
    {"imu_raw_units", "g_dps or si",
     [](S t, P& p) { return p.client.imu_units = static_cast<bota_ethercat::ImuUnits>(t == "si"), t == "si" || t == "g_dps"; }},
    {"payload_file", "a file that ethercat-identify --yaml or ~/identify/solve wrote",
     [](S t, P& p) { return read_payload(std::string(t), p); }},
    // Of the tool, under the names that the file has:
    {"tool_mass", "0 to 1000 (kg)",
     [](S t, P& p) { return p.has_payload = p.wants_imu = number(t, 0.0, 1000.0, p.payload.mass); }},
    {"tool_center_of_gravity", "three numbers (m)", [](S t, P& p) { return numbers(t, p.payload.center); }},
    {"tool_inertia", "six numbers (kg m^2)", [](S t, P& p) { return numbers(t, p.payload.inertia); }},
    {"accelerometer.offset", "three numbers (m/s^2)", [](S t, P& p) { return numbers(t, p.payload.accelerometer_offset); }},
    {"accelerometer.scale", "three numbers, about 1", [](S t, P& p) { return numbers(t, p.payload.accelerometer_scale, 0.1); }},
    {"accelerometer.cross_axis", "six numbers", [](S t, P& p) { return numbers(t, p.payload.accelerometer_cross_axis); }},
    {"tool_center_of_gravity_interval", "three numbers (m)", [](S t, P& p) { return numbers(t, p.payload.center_interval, 0.0); }},
    {"tool_inertia_interval", "six numbers (kg m^2)", [](S t, P& p) { return numbers(t, p.payload.inertia_interval, 0.0); }},
    {"accelerometer.offset_interval", "three numbers (m/s^2)", [](S t, P& p) { return numbers(t, p.payload.offset_interval, 0.0); }},
    {"accelerometer.scale_interval", "three numbers", [](S t, P& p) { return numbers(t, p.payload.scale_interval, 0.0); }},
    {"accelerometer.cross_axis_interval", "six numbers", [](S t, P& p) { return numbers(t, p.payload.cross_axis_interval, 0.0); }},
    {"gyroscope_matrix", "nine numbers", [](S t, P& p) { return numbers(t, p.payload.gyroscope); }},
    {"imu_position", "three numbers (m)", [](S t, P& p) { return numbers(t, p.payload.imu_position); }},
    {"accuracy.noise", "six numbers (N, Nm)", [](S t, P& p) { return numbers(t, p.payload.noise, 0.0); }},
    {"accuracy.left", "six numbers", [](S t, P& p) { return numbers(t, p.payload.left, 0.0); }},
    {"bias", "six numbers (N, Nm)", [](S t, P& p) { return numbers(t, p.bias); }},
    {"sensor_offset", "six numbers (N, Nm)", [](S t, P& p) { return numbers(t, p.sensor_offset.emplace()); }},
};
inline constexpr std::size_t kOfTool = 17;  // the last rows

/// Parameters of the ROS 2 node in a YAML file, a line each; false if they are wrong, or tool_mass is not among them.
inline bool read_payload(const std::string& path, Parameters& into) {
    std::ifstream file(path);
    for (std::string line; std::getline(file, line);) {
        const S text = S(line).substr(0, line.find('#'));
        const std::size_t colon = std::min(text.find(':'), text.size());
        for (const Row* row = std::end(kRows) - kOfTool; row != std::end(kRows); ++row)
            if (stripped(text.substr(0, colon)) == row->name && !row->parse(stripped(text.substr(colon + 1)), into)) return false;
    }
    return into.has_payload;
}

/// That there is nothing of this kind and name, and what there is.
template <typename Names>
std::string unknown(std::string_view kind, std::string_view name, const Names& names) {
    std::string all;
    for (const std::string_view each : names) all.append(all.empty() ? "" : ", ").append(each);
    return "there is no " + std::string(kind) + " \"" + std::string(name) + "\"; there are: " + all;
}

}  // namespace detail

/// Take one parameter; what is wrong with it, or nothing.
inline std::string set_parameter(Parameters& parameters, std::string_view name, std::string_view value) {
    std::vector<std::string_view> names;
    for (const detail::Row& row : detail::kRows) {
        names.push_back(row.name);
        if (row.name != name) continue;
        if (row.parse(detail::stripped(value), parameters)) return {};
        return "the parameter " + std::string(name) + " is \"" + std::string(value) + "\"; allowed: " + row.allowed;
    }
    return detail::unknown("parameter", name, names);
}

}  // namespace bota_ethercat_hardware
