// SPDX-License-Identifier: Apache-2.0
// Tells a virtual sensor what it feels (`ethercat-virtual-sensor IFACE --world PATH`): docs/world.md.
#pragma once

#include <sys/socket.h>
#include <sys/un.h>
#include <unistd.h>

#include <array>
#include <cstdint>
#include <cstring>
#include <string_view>

namespace bota_ethercat {

/// What the sensor feels, in its own frame: N, Nm, m/s^2 (specific force; at rest it points up), rad/s, degrees Celsius.
struct Felt {
    std::array<double, 6> wrench{};
    std::array<double, 3> acceleration{0.0, 0.0, 9.80665};
    std::array<double, 3> angular_rate{};
    double temperature = 35.0;
};

/// The way to a virtual sensor, which may start, end and start again. Allocates nothing, throws nothing, does not wait.
class World {
public:
    explicit World(std::string_view path) noexcept : socket_(::socket(AF_UNIX, SOCK_DGRAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0)) {
        address_.sun_family = AF_UNIX;
        if (path.size() < sizeof address_.sun_path) std::memcpy(address_.sun_path, path.data(), path.size());
    }
    ~World() { ::close(socket_); }
    World(const World&) = delete;
    World& operator=(const World&) = delete;

    /// What the sensor at this position feels at `t`, s of CLOCK_MONOTONIC; false if there is none, or it is behind.
    bool send(double t, const Felt& felt, std::uint8_t sensor = 0) noexcept {
        std::array<std::uint8_t, 120> bytes{'F', 'T', 'W', '1', sensor};
        std::uint8_t* at = bytes.data() + 8;
        const auto put = [&at](double value) {
            std::uint64_t bits = 0;
            std::memcpy(&bits, &value, sizeof bits);
            for (int shift = 0; shift < 64; shift += 8) *at++ = static_cast<std::uint8_t>(bits >> shift);
        };
        put(t);
        for (const double value : felt.wrench) put(value);
        for (const double value : felt.acceleration) put(value);
        for (const double value : felt.angular_rate) put(value);
        put(felt.temperature);
        const auto* address = reinterpret_cast<const sockaddr*>(&address_);
        return ::sendto(socket_, bytes.data(), bytes.size(), 0, address, sizeof address_) >= 0;
    }

private:
    int socket_;
    sockaddr_un address_{};
};

}  // namespace bota_ethercat
