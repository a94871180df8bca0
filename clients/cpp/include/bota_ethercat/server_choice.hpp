// Which server a program uses, as the Python programs have it: `--server HOST:PORT`, else $BOTA_SERVER, else localhost:12001.
#ifndef BOTA_ETHERCAT_SERVER_CHOICE_HPP
#define BOTA_ETHERCAT_SERVER_CHOICE_HPP

#include <charconv>
#include <cstdint>
#include <cstdlib>
#include <string>
#include <string_view>

#include "bota_ethercat/reading.hpp"

namespace bota_ethercat {

/// Reads HOST:PORT, HOST, :PORT or PORT, an IPv6 address in brackets; false, and nothing is changed, if it is none of these.
inline bool parse_server(std::string_view text, std::string& host, std::uint16_t& port) {
    const Options defaults;
    std::string_view name = text, digits;
    const std::size_t colon = text.rfind(':');
    if (!text.empty() && text.find_first_not_of("0123456789") == text.npos) {
        name = {};
        digits = text;
    } else if (colon != text.npos && text.back() != ']') {
        name = text.substr(0, colon);
        digits = text.substr(colon + 1);
        if (digits.empty()) return false;
    }
    std::uint16_t number = defaults.port;
    const auto [end, error] = std::from_chars(digits.data(), digits.data() + digits.size(), number);
    if (!digits.empty() && (error != std::errc() || end != digits.data() + digits.size() || number == 0)) return false;
    if (name.size() > 1 && name.front() == '[' && name.back() == ']') name = name.substr(1, name.size() - 2);
    else if (name.find(':') != name.npos) return false;  // an IPv6 address without brackets
    host = name.empty() ? defaults.host : std::string(name);
    port = number;
    return true;
}

/// Sets `host` and `port` to the server `given`, or if that is null to $BOTA_SERVER, if there is one. If false, neither is
/// changed: `parse_server` takes no such text.
inline bool choose_server(const char* given, Options& options) {
    if (given == nullptr) given = std::getenv("BOTA_SERVER");
    if (given == nullptr || *given == '\0') return true;
    return parse_server(given, options.host, options.port);
}

}  // namespace bota_ethercat

#endif  // BOTA_ETHERCAT_SERVER_CHOICE_HPP
