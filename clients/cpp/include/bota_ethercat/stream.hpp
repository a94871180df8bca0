// The stream of samples: `Client`, all that a controller needs. The top of bota_ethercat.hpp has units, threads, real time.
//
//     bota_ethercat::Options options;
//     options.max_age = std::chrono::milliseconds(5);
//     options.reconnect = bota_ethercat::Reconnect::when_told;  // the loop makes no system call but recv and clock_gettime
//     bota_ethercat::Client sensor(options);
#ifndef BOTA_ETHERCAT_STREAM_HPP
#define BOTA_ETHERCAT_STREAM_HPP

#include <cstdint>
#include <string>
#include <type_traits>
#include <utility>

#include "bota_ethercat/reading.hpp"
#include "bota_ethercat/subscription.hpp"

namespace bota_ethercat {

/// A subscription to the samples of one server.
///
/// If the connection is lost, readings report `Condition::disconnected` (or `fresh` for as long as the last sample is
/// younger than `max_age`) and keep the last sample, whose age grows. By default `latest`, `update` and `next` go on trying to
/// connect; with `Reconnect::when_told` only `reconnect` and `connect` do. Host names are asked for in `connect` only.
/// After a new connection the first sample has `gap`, and `connection` is one more.
///
///     bota_ethercat::Client first({"localhost", 12001}), second("localhost", 12002);
///     first = std::move(second);  // what is left of `second` can only be destroyed or assigned to
class Client : public detail::Subscription {
public:
    /// Allocates everything that is ever needed.
    explicit Client(Options options = {}) : Subscription(std::move(options)) {}
    explicit Client(std::string host, std::uint16_t port) : Client(options_for(std::move(host), port)) {}

    // As `Client(const Client&)` or `Client(Client&&)` these would make `Client({"localhost", 12001})` ambiguous: the braces could
    // be a client to copy or move from. A template and a reference to an lvalue cannot be made from braces.
    Client(Client&) = delete;
    template <typename Other, typename = std::enable_if_t<std::is_same_v<Other, Client>>>
    Client(Other&& other) noexcept : Subscription(std::move(other)) {}
    Client& operator=(Client&&) noexcept = default;

private:
    static Options options_for(std::string host, std::uint16_t port) {
        Options options;
        options.host = std::move(host);
        options.port = port;
        return options;
    }
};

}  // namespace bota_ethercat

#endif  // BOTA_ETHERCAT_STREAM_HPP
