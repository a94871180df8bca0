// The parameters of a <hardware> tag: one table of names, defaults and what is allowed. Wrong ones are refused in a sentence.
#pragma once

#include <algorithm>
#include <array>
#include <charconv>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <limits>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include <bota_ethercat.hpp>

namespace bota_ethercat_hardware {

using std::chrono::nanoseconds;

/// What controllers see while there is no sample to act on.
enum class Reaction : std::uint8_t {
    error,  ///< read() fails at once: the controller manager stops the controllers of this sensor
    nan,    ///< NaN, and an error after `error_after`
    hold,   ///< the last usable sample, and an error after `error_after`
    use,    ///< the sample as it is
};

constexpr std::string_view to_string(Reaction reaction) noexcept {
    constexpr std::string_view kNames[] = {"error", "nan", "hold", "use"};
    return kNames[static_cast<int>(reaction)];
}

struct Parameters {
    std::string host = "localhost";
    std::uint16_t port = 12001;
    std::uint8_t sensor = 0;                 ///< position on the bus
    std::optional<std::uint32_t> serial;     ///< another sensor at that position is refused
    std::optional<double> max_age;           ///< s; none: four sample periods, at least 0.01
    Reaction on_stale = Reaction::nan;       ///< no sample younger than `max_age`
    Reaction on_saturated = Reaction::nan;   ///< the newest sample is saturated
    Reaction on_invalid = Reaction::nan;     ///< what comes cannot be trusted
    double error_after = 0.5;                ///< s of nan or hold until read() fails; infinity: never
    double connect_timeout = 5.0;            ///< s that on_configure waits for the server
    bool on_activate_tare = false;
    int receive_priority = 51;               ///< SCHED_FIFO, of the receiving thread, above a controller manager's 50; 0: none
    bota_ethercat::ImuUnits imu_raw_units = bota_ethercat::ImuUnits::g_dps;
    // From the <sensor> tag:
    bool wants_imu = false, wants_orientation = false;
};

namespace detail {

inline std::string_view stripped(std::string_view text) noexcept {
    constexpr std::string_view kBlanks = " \t\r\n";
    const std::size_t from = text.find_first_not_of(kBlanks);
    if (from == std::string_view::npos) return {};
    return text.substr(from, text.find_last_not_of(kBlanks) + 1 - from);
}

/// A number, the whole of the text and nothing else, whatever the locale.
template <typename Number>
bool number(std::string_view text, Number least, Number most, Number& into) noexcept {
    Number found{};
    const auto done = std::from_chars(text.data(), text.data() + text.size(), found);
    if (done.ec != std::errc() || done.ptr != text.data() + text.size() || !(found >= least && found <= most)) return false;
    into = found;
    return true;
}

inline bool flag(std::string_view text, bool& into) noexcept {  // xacro writes them as Python does
    if (text != "true" && text != "True" && text != "false" && text != "False") return false;
    into = text.size() == 4;
    return true;
}

inline bool reaction(std::string_view text, Reaction most, Reaction& into) noexcept {
    for (int i = 0; i <= static_cast<int>(most); ++i)
        if (text == to_string(static_cast<Reaction>(i))) return into = static_cast<Reaction>(i), true;
    return false;
}

struct Row {
    std::string_view name, allowed;
    bool (*parse)(std::string_view text, Parameters& into);
};

using P = Parameters;
using S = std::string_view;
inline constexpr Row kRows[] = {
    {"host", "a host name or address", [](S t, P& p) { return !t.empty() && (p.host = t, true); }},
    {"port", "1 to 65535", [](S t, P& p) { return number<std::uint16_t>(t, 1, 65535, p.port); }},
    {"sensor", "a position on the bus, 0 to 255", [](S t, P& p) { return number<std::uint8_t>(t, 0, 255, p.sensor); }},
    {"serial", "a serial number in decimal digits",
     [](S t, P& p) { return number<std::uint32_t>(t, 0, 0xFFFFFFFF, p.serial.emplace()); }},
    {"max_age", "0.001 to 10 (s)", [](S t, P& p) { return number(t, 0.001, 10.0, p.max_age.emplace()); }},
    {"on_stale", "error, nan or hold", [](S t, P& p) { return reaction(t, Reaction::hold, p.on_stale); }},
    {"on_saturated", "error, nan, hold or use", [](S t, P& p) { return reaction(t, Reaction::use, p.on_saturated); }},
    {"on_invalid", "error, nan or hold", [](S t, P& p) { return reaction(t, Reaction::hold, p.on_invalid); }},
    {"error_after", "0 or more (s), or inf for never",
     [](S t, P& p) { return number(t, 0.0, std::numeric_limits<double>::infinity(), p.error_after); }},
    {"connect_timeout", "0 to 600 (s)", [](S t, P& p) { return number(t, 0.0, 600.0, p.connect_timeout); }},
    {"on_activate_tare", "true or false", [](S t, P& p) { return flag(t, p.on_activate_tare); }},
    {"receive_priority", "0 to 99", [](S t, P& p) { return number(t, 0, 99, p.receive_priority); }},
    {"imu_raw_units", "g_dps or si",
     [](S t, P& p) {
         p.imu_raw_units = t == "si" ? bota_ethercat::ImuUnits::si : bota_ethercat::ImuUnits::g_dps;
         return t == "si" || t == "g_dps";
     }},
};

/// How many letters must be changed, added or left out.
inline std::size_t distance(std::string_view a, std::string_view b) {
    std::vector<std::size_t> row(b.size() + 1);
    for (std::size_t j = 0; j <= b.size(); ++j) row[j] = j;
    for (std::size_t i = 1; i <= a.size(); ++i) {
        std::size_t diagonal = row[0]++;
        for (std::size_t j = 1; j <= b.size(); ++j) {
            const std::size_t above = row[j];
            row[j] = std::min({above + 1, row[j - 1] + 1, diagonal + (a[i - 1] == b[j - 1] ? 0 : 1)});
            diagonal = above;
        }
    }
    return row[b.size()];
}

/// " (did you mean "NAME"?)", if there is one of nearly that name.
template <typename Names>
std::string meant(std::string_view name, const Names& names) {
    std::size_t least = 1 + name.size() / 3;
    std::string found;
    for (const std::string_view each : names)
        if (const std::size_t found_at = distance(name, each); found_at <= least) {
            found = " (did you mean \"" + std::string(each) + "\"?)";
            least = found_at - (found_at > 0 ? 1 : 0);
        }
    return found;
}

template <typename Names>
std::string listed(const Names& names) {
    std::string text;
    for (const std::string_view each : names) text.append(text.empty() ? "" : ", ").append(each);
    return text;
}

}  // namespace detail

/// Take one parameter; what is wrong with it, or nothing.
inline std::string set_parameter(Parameters& parameters, std::string_view name, std::string_view value) {
    std::array<std::string_view, std::size(detail::kRows)> names{};
    std::transform(std::begin(detail::kRows), std::end(detail::kRows), names.begin(), [](const auto& row) { return row.name; });
    const auto row = std::find_if(std::begin(detail::kRows), std::end(detail::kRows), [&](const auto& r) { return r.name == name; });
    if (row == std::end(detail::kRows))
        return "there is no parameter \"" + std::string(name) + "\"" + detail::meant(name, names) +
               "; there are: " + detail::listed(names);
    if (row->parse(detail::stripped(value), parameters)) return {};
    return "the parameter " + std::string(name) + " is \"" + std::string(value) + "\"; allowed: " + std::string(row->allowed);
}

}  // namespace bota_ethercat_hardware
