// Whether a server shares this machine's CLOCK_MONOTONIC, so that its stamps can be compared with ours.
//
// The server names its clock in `boot_id`: protocol/address.py in C++. Addresses alone can be wrong: a tunnel makes another
// machine look local, and a container on this one looks remote. They decide only where the server names no clock.
#ifndef BOTA_ETHERCAT_MACHINE_HPP
#define BOTA_ETHERCAT_MACHINE_HPP

#include <fcntl.h>
#include <netinet/in.h>
#include <sys/socket.h>
#include <sys/types.h>
#include <unistd.h>

#include <array>
#include <cstddef>
#include <cstring>
#include <string_view>

#include "bota_ethercat/json.hpp"
#include "bota_ethercat/text.hpp"

namespace bota_ethercat::detail {

using ClockName = Text<96>;

/// What a small file holds; false if it cannot be read.
template <std::size_t Size>
bool read_file(const char* path, std::array<char, Size>& buffer, std::string_view& text) noexcept {
    const int fd = ::open(path, O_RDONLY | O_CLOEXEC);
    if (fd < 0) return false;
    const ssize_t count = ::read(fd, buffer.data(), buffer.size());
    ::close(fd);
    text = {buffer.data(), count > 0 ? static_cast<std::size_t>(count) : 0};
    return count > 0;
}

/// The next word of `text`, which is cut off from it; empty at the end.
inline std::string_view take_word(std::string_view& text) noexcept {
    constexpr std::string_view kBlanks = " \t\n";
    const std::size_t from = text.find_first_not_of(kBlanks);
    text.remove_prefix(from == std::string_view::npos ? text.size() : from);
    const std::string_view word = text.substr(0, text.find_first_of(kBlanks));
    text.remove_prefix(word.size());
    return word;
}

/// The name of this process's CLOCK_MONOTONIC: the kernel's boot and, in a time namespace that shifts the clock, by how much.
/// Empty if it cannot be known.
inline ClockName clock_name() noexcept {
    ClockName name;
    std::array<char, 512> buffer{};
    std::string_view text;
    if (!read_file("/proc/sys/kernel/random/boot_id", buffer, text)) return name;
    name.add(take_word(text));
    if (!read_file("/proc/self/timens_offsets", buffer, text)) return name;  // a kernel without time namespaces
    while (!text.empty()) {
        if (take_word(text) != "monotonic") continue;
        const std::string_view seconds = take_word(text), ns = take_word(text);
        if (seconds != "0" || ns != "0") name.add(" ").add(seconds).add(" ").add(ns);
        break;
    }
    return name;
}

/// Whether the other end of a connection has an address of this machine.
inline bool same_address(int fd) noexcept {
    sockaddr_storage here{}, there{};
    socklen_t here_size = sizeof here, there_size = sizeof there;
    if (getsockname(fd, reinterpret_cast<sockaddr*>(&here), &here_size) != 0 ||
        getpeername(fd, reinterpret_cast<sockaddr*>(&there), &there_size) != 0 || here.ss_family != there.ss_family)
        return false;
    if (there.ss_family == AF_INET) {
        sockaddr_in mine{}, others{};
        std::memcpy(&mine, &here, sizeof mine);
        std::memcpy(&others, &there, sizeof others);
        return mine.sin_addr.s_addr == others.sin_addr.s_addr || ntohl(others.sin_addr.s_addr) >> 24 == 127;
    }
    if (there.ss_family == AF_INET6) {
        sockaddr_in6 mine{}, others{};
        std::memcpy(&mine, &here, sizeof mine);
        std::memcpy(&others, &there, sizeof others);
        return std::memcmp(&mine.sin6_addr, &others.sin6_addr, sizeof mine.sin6_addr) == 0;
    }
    return false;
}

/// The same with what the server says of itself. `ours` is our clock's name.
inline bool same_clock(int fd, json::Value description, const ClockName& ours) noexcept {
    const json::Value theirs = description["boot_id"];
    return theirs.is_string() && !ours.empty() ? theirs.is(ours.view()) : same_address(fd);
}

}  // namespace bota_ethercat::detail

#endif  // BOTA_ETHERCAT_MACHINE_HPP
