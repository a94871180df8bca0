// SPDX-License-Identifier: Apache-2.0
// Which server (`Options`, `choose_server`), and the connection to it: from a host name to messages, without blocking.
#pragma once

#include <netdb.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <charconv>
#include <chrono>
#include <cstdlib>
#include <cstring>
#include <fstream>
#include <limits>
#include <memory>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "bota_ethercat/protocol.hpp"

namespace bota_ethercat {

using std::chrono::nanoseconds;

/// CLOCK_MONOTONIC in ns: what intervals and ages are measured with.
inline std::int64_t monotonic_now_ns() noexcept {
    timespec now{};
    clock_gettime(CLOCK_MONOTONIC, &now);
    return std::int64_t{now.tv_sec} * 1'000'000'000 + now.tv_nsec;
}

/// What reconnects after a loss.
enum class Reconnect : std::uint8_t {
    by_itself,  ///< `latest`, `update` and `next`, a non-blocking step in each call
    when_told,  ///< only `Client::reconnect` and `connect`; without a connection the others just read the clock
};

struct Options {
    std::string host = "localhost";
    std::uint16_t port = 12001;
    std::vector<std::uint8_t> sensors{};  ///< positions on the bus; empty = all
    std::uint32_t every = 1;              ///< one frame in `every`
    bool fresh_only = true;               ///< REPEATED frames only every 10 ms, to show that the sensor is silent
    ImuUnits imu_units = ImuUnits::g_dps;
    nanoseconds max_age = std::chrono::milliseconds(10);  ///< an older sample is never `Condition::fresh`
    bool judge_imu = false;  ///< `Condition` judges acceleration, angular rate and orientation too, not only force and torque
    Reconnect reconnect = Reconnect::by_itself;
    nanoseconds reconnect_every = std::chrono::milliseconds(100);  ///< shortest time between two attempts
    std::size_t max_bytes_per_call = 262144;  ///< that `update` and `latest` read at most; some 2700 frames
    int receive_buffer = 65536;  ///< SO_RCVBUF: how much old data a stall can leave; at least 16384, 0 = the system's
};

/// Reads HOST:PORT, HOST, :PORT or PORT, an IPv6 address in brackets; false, and nothing is changed, if it is none of these.
inline bool parse_server(std::string_view text, std::string& host, std::uint16_t& port) {
    const Options defaults;
    std::string_view name, digits = text;
    if (text.empty() || text.find_first_not_of("0123456789") != text.npos) {
        const std::size_t colon = !text.empty() && text.back() == ']' ? text.npos : text.rfind(':');
        name = text.substr(0, colon);
        digits = colon == text.npos ? std::string_view() : text.substr(colon + 1);
        if (digits.empty() && colon != text.npos) return false;
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

/// How far a connection is.
enum class Link : std::uint8_t { down, connecting, subscribing, up };

namespace detail {

using Message = Text<320>;

/// `now` plus a duration, without overflow: a very long one is "never".
inline std::int64_t after(std::int64_t now_ns, nanoseconds duration) noexcept {
    constexpr std::int64_t never = std::numeric_limits<std::int64_t>::max();
    const std::int64_t more = std::max<std::int64_t>(duration.count(), 0);
    return more > never - now_ns ? never : now_ns + more;
}

/// Start an error message with the server's address.
inline Message& start_error(Message& error, const Options& options) noexcept {
    error.clear();
    return error.add(options.host).add(" port ").add(std::int64_t{options.port}).add(": ");
}

/// The name of this process's CLOCK_MONOTONIC, as a server names its own in `boot_id`: the kernel's boot and, in a time
/// namespace that shifts the clock, by how much. Empty if it cannot be known. bota_ethercat/address.py in C++.
inline std::string clock_name() {
    std::string name, word, seconds, ns;
    if (!(std::ifstream("/proc/sys/kernel/random/boot_id") >> name)) return {};
    for (std::ifstream offsets("/proc/self/timens_offsets"); offsets >> word >> seconds >> ns;)
        if (word == "monotonic" && (seconds != "0" || ns != "0")) name.append(" ").append(seconds).append(" ").append(ns);
    return name;
}

/// A file descriptor; closes itself.
class Socket {
public:
    explicit Socket(int fd = -1) noexcept : fd_(fd) {}
    Socket(Socket&& other) noexcept : fd_(std::exchange(other.fd_, -1)) {}
    Socket& operator=(Socket other) noexcept { return std::swap(fd_, other.fd_), *this; }
    ~Socket() { close(); }

    int fd() const noexcept { return fd_; }
    void close() noexcept {
        if (fd_ >= 0) ::close(std::exchange(fd_, -1));
    }

private:
    int fd_;
};

/// A connection to one of a host's addresses, and the request that is sent over it.
class Connection {
public:
    Options options;
    Message error;  ///< why there is no connection, or the server's last error message: a sentence, for a person
    Link link = Link::down;
    bool is_shutting_down = false;                  ///< the server has announced it
    std::int64_t now_ns = 0, received_ns = 0;       ///< CLOCK_MONOTONIC of the current step, and of the newest bytes

    /// `request` is sent on every new connection, and answered within `patience`.
    Connection(Options wanted, std::string request, nanoseconds patience = std::chrono::seconds(2))
        : options(std::move(wanted)), request_(std::move(request)), patience_(patience) {
        error.add("not connected yet: call connect()");
    }

    int fd() const noexcept { return link == Link::down ? -1 : socket_.fd(); }

    // -- connecting

    /// Look up the host and try its addresses until one accepts. `handle` gets each JSON message until it sets the link
    /// `up`. Blocks; there is no timeout for name servers.
    template <typename Handle>
    bool connect(nanoseconds timeout, const Handle& handle) noexcept {
        const std::int64_t deadline_ns = after(monotonic_now_ns(), timeout);
        drop();
        socket_.close();
        if (!resolve()) return false;
        now_ns = monotonic_now_ns();
        was_accepted_ = false;
        for (const addrinfo* each = addresses_.get(); each != nullptr && !was_accepted_; each = each->ai_next) {
            begin();
            while (link != Link::down) {
                advance(handle);
                if (link == Link::up) return true;
                if (link == Link::down) break;
                if (now_ns >= deadline_ns) lose("the server did not answer in time");
                else (void)wait(deadline_ns);
            }
        }
        return false;
    }

    /// A step towards a connection, if it is time for one.
    void step() noexcept {
        if (link == Link::down && now_ns >= retry_at_ns_) begin();
        if (link == Link::connecting) finish_connecting();
    }

    /// A step towards a connection, and read until the reply to the request; not the messages after it.
    template <typename Handle>
    void advance(const Handle& handle) noexcept {
        if (link < Link::subscribing) step();
        Frame frame;
        std::string_view text;
        std::size_t budget = options.max_bytes_per_call;
        do {
            auto found = FrameDecoder::Found::data;
            while (link == Link::subscribing && found != FrameDecoder::Found::nothing)
                if ((found = next(frame, text)) == FrameDecoder::Found::json) handle(text);
        } while (link == Link::subscribing && receive(budget) > 0 && budget > 0);
    }

    /// Wait until something arrives or a step is due, at most until `until_ns`; false if a signal came.
    bool wait(std::int64_t until_ns) noexcept {
        if (link == Link::down && addresses_) until_ns = std::min(until_ns, retry_at_ns_);
        if (link == Link::connecting || link == Link::subscribing) until_ns = std::min(until_ns, attempt_ends_ns_);
        const std::int64_t left = std::max<std::int64_t>(until_ns - now_ns, 0);
        const timespec timeout{static_cast<time_t>(left / 1'000'000'000), static_cast<long>(left % 1'000'000'000)};
        pollfd one{socket_.fd(), static_cast<short>(link == Link::connecting ? POLLOUT : POLLIN), 0};
        const bool was_interrupted = ::ppoll(&one, link == Link::down ? 0 : 1, &timeout, nullptr) < 0 && errno == EINTR;
        now_ns = monotonic_now_ns();
        return !was_interrupted;
    }

    /// Whether the other end has an address of this machine. Addresses can be wrong, a tunnel's or a container's: they count
    /// where the server does not name its clock.
    bool has_one_address() const noexcept {
        std::array<sockaddr_storage, 2> ends{};
        std::array<socklen_t, 2> sizes{sizeof ends[0], sizeof ends[1]};
        if (getsockname(socket_.fd(), reinterpret_cast<sockaddr*>(&ends[0]), &sizes[0]) != 0 ||
            getpeername(socket_.fd(), reinterpret_cast<sockaddr*>(&ends[1]), &sizes[1]) != 0)
            return false;
        for (sockaddr_storage& end : ends)  // the port is at one place in both families
            std::memset(reinterpret_cast<char*>(&end) + offsetof(sockaddr_in, sin_port), 0, sizeof(in_port_t));
        return sizes[0] == sizes[1] && std::memcmp(&ends[0], &ends[1], sizes[0]) == 0;
    }

    // -- what arrives

    /// Receive once, at most `budget` bytes, and subtract what came from it; 0 if nothing has arrived or the connection is over.
    std::size_t receive(std::size_t& budget) noexcept {
        std::size_t room = 0;
        std::uint8_t* const into = decoder_.space(room);
        const ssize_t count = ::recv(socket_.fd(), into, std::min(room, budget), MSG_DONTWAIT);
        const int failed = errno;
        now_ns = monotonic_now_ns();
        if (count > 0) {
            received_ns = now_ns;
            decoder_.received(static_cast<std::size_t>(count));
            budget -= static_cast<std::size_t>(count);
            return static_cast<std::size_t>(count);
        }
        if (count == 0) lose(is_shutting_down ? "the server was shut down" : "the server closed the connection");
        else if (failed != EAGAIN && failed != EINTR) fail(failed);
        else if (link == Link::subscribing && now_ns >= attempt_ends_ns_) lose("the server did not answer in time");
        return 0;
    }

    /// The next message received; a server that breaks the framing is disconnected.
    FrameDecoder::Found next(Frame& frame, std::string_view& text) noexcept {
        const FrameDecoder::Found found = decoder_.next(frame, text);
        if (found == FrameDecoder::Found::broken) {
            set_error("the server sent ").add(decoder_.reason()).add(": is that ethercat-server?");
            drop();
        }
        return found;
    }

    // -- the end

    /// The connection is over; `why` completes the error message.
    void lose(std::string_view why) noexcept {
        set_error(why);
        drop();
    }

    /// Nothing is tried again until `connect`.
    void close() noexcept {
        lose("closed by this program");
        socket_.close();
        addresses_.reset();
    }

    void drop() noexcept {
        // When told, the next step closes it: not a call of the control loop.
        if (options.reconnect != Reconnect::when_told) socket_.close();
        decoder_.reset();
        link = Link::down;
        is_shutting_down = false;
    }

    Message& set_error(std::string_view what) noexcept { return start_error(error, options).add(what); }

private:
    bool resolve() noexcept {
        addrinfo wanted{}, *found = nullptr;
        wanted.ai_socktype = SOCK_STREAM;
        Text<8> service;
        service.add(std::int64_t{options.port});
        const int result = getaddrinfo(options.host.c_str(), service.c_str(), &wanted, &found);
        addresses_.reset(found);
        next_address_ = nullptr;
        if (result == 0) return true;
        error.clear();
        error.add("no address for ").add(options.host).add(": ").add(gai_strerror(result));
        return false;
    }

    /// Begin to connect to the next of the addresses.
    void begin() noexcept {
        if (!addresses_) return;
        const addrinfo& address = next_address_ == nullptr ? *addresses_ : *next_address_;
        next_address_ = address.ai_next;
        attempt_ends_ns_ = after(now_ns, patience_);
        retry_at_ns_ = after(now_ns, options.reconnect_every);
        socket_ = Socket(::socket(address.ai_family, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0));
        if (socket_.fd() < 0) return fail(errno);
        set(IPPROTO_TCP, TCP_NODELAY, 1);
        // An unreachable host is noticed within some 5 s. A stopped server still answers probes.
        set(SOL_SOCKET, SO_KEEPALIVE, 1);
        set(IPPROTO_TCP, TCP_KEEPIDLE, 2);
        set(IPPROTO_TCP, TCP_KEEPINTVL, 1);
        set(IPPROTO_TCP, TCP_KEEPCNT, 3);
        // With less TCP needs hundreds of milliseconds to get going again after a stall.
        if (options.receive_buffer > 0) set(SOL_SOCKET, SO_RCVBUF, std::max(options.receive_buffer, 16384));
        link = Link::connecting;
        if (::connect(socket_.fd(), address.ai_addr, address.ai_addrlen) != 0 && errno != EINPROGRESS) fail(errno);
    }

    void finish_connecting() noexcept {
        pollfd one{socket_.fd(), POLLOUT, 0};
        if (::poll(&one, 1, 0) <= 0) {
            if (now_ns >= attempt_ends_ns_) fail(ETIMEDOUT);
            return;
        }
        int failed = 0;
        socklen_t size = sizeof failed;
        if (getsockopt(socket_.fd(), SOL_SOCKET, SO_ERROR, &failed, &size) != 0) failed = errno;
        if (failed != 0) return fail(failed);
        was_accepted_ = true;
        // A fresh connection has room for all of it.
        if (::send(socket_.fd(), request_.data(), request_.size(), MSG_NOSIGNAL) != static_cast<ssize_t>(request_.size()))
            return lose("the request could not be sent");
        link = Link::subscribing;
    }

    /// As `lose`. Not strerror: that may allocate.
    void fail(int error_number) noexcept {
        switch (set_error(""); error_number) {
            case ECONNREFUSED: error.add("nobody listens there: start ethercat-server, or give its address"); break;
            case ECONNRESET: case EPIPE: error.add("the server reset the connection"); break;
            case ETIMEDOUT: error.add("no answer"); break;
            case EHOSTUNREACH: case ENETUNREACH: error.add("no route to that host"); break;
            case EMFILE: case ENFILE: error.add("too many open files"); break;
            default: error.add("error ").add(std::int64_t{error_number});
        }
        drop();
    }

    void set(int level, int name, int value) noexcept { setsockopt(socket_.fd(), level, name, &value, sizeof value); }

    std::string request_;
    nanoseconds patience_;
    FrameDecoder decoder_;
    Socket socket_;
    std::unique_ptr<addrinfo, decltype(&freeaddrinfo)> addresses_{nullptr, freeaddrinfo};  // null before `connect`
    const addrinfo* next_address_ = nullptr;  // null: the first
    std::int64_t attempt_ends_ns_ = 0, retry_at_ns_ = 0;
    bool was_accepted_ = false;
};

}  // namespace detail

}  // namespace bota_ethercat
