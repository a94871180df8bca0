// The connection of a stream: from a host name to messages, in steps that do not block.
#ifndef BOTA_ETHERCAT_CONNECTION_HPP
#define BOTA_ETHERCAT_CONNECTION_HPP

#include <sys/types.h>

#include <cerrno>
#include <cstddef>
#include <cstdint>
#include <string>
#include <string_view>
#include <utility>

#include "bota_ethercat/framing.hpp"
#include "bota_ethercat/reading.hpp"
#include "bota_ethercat/socket.hpp"
#include "bota_ethercat/text.hpp"

namespace bota_ethercat {

/// How far a connection is.
enum class Link : std::uint8_t { down, connecting, subscribing, up };

namespace detail {

class Connection {
public:
    /// `subscribe` is sent on every new connection.
    Connection(const Options& options, std::string subscribe)
        : host_(options.host), port_(options.port), receive_buffer_(options.receive_buffer),
          reconnect_every_(options.reconnect_every), closes_late_(options.reconnect == Reconnect::when_told),
          subscribe_(std::move(subscribe)) {
        error_.add("not connected yet: call connect()");
    }

    Link link() const noexcept { return link_; }
    bool usable() const noexcept { return decoder_.usable(); }
    int fd() const noexcept { return link_ == Link::down ? -1 : socket_.fd(); }
    const Message& error() const noexcept { return error_; }
    /// How many addresses the host has; 0 before `resolve` and after `close`.
    std::size_t addresses() const noexcept { return addresses_.count; }
    std::int64_t attempt_ends_ns() const noexcept { return attempt_ends_ns_; }
    std::int64_t retry_at_ns() const noexcept { return retry_at_ns_; }

    // -- connecting

    /// Ask for the host's addresses, which may wait for name servers; ends the connection there is.
    bool resolve() noexcept {
        drop();
        socket_.close();
        return addresses_.resolve(host_, port_, error_);
    }

    /// A step towards a connection, if it is time for one.
    void step(std::int64_t now_ns) noexcept {
        if (link_ == Link::down && now_ns >= retry_at_ns_) begin(now_ns);
        if (link_ == Link::connecting) finish_connecting(now_ns);
    }

    void begin(std::int64_t now_ns) noexcept {
        if (addresses_.count == 0) return;
        const std::size_t which = next_address_++ % addresses_.count;
        attempt_ends_ns_ = now_ns + kAttemptNs;
        retry_at_ns_ = after(now_ns, reconnect_every_);
        const int failed = socket_.begin(addresses_.address[which], addresses_.length[which], receive_buffer_);
        if (failed != 0)
            lose(failed);
        else
            link_ = Link::connecting;
    }

    /// The server granted the subscription.
    void granted() noexcept {
        link_ = Link::up;
        error_.clear();
    }

    // -- what arrives

    /// Receive once, at most `budget` bytes, which become less. The number, 0 for nothing now, -1 if that was the end.
    /// `now_ns` becomes the time after that.
    ssize_t receive(std::size_t& budget, std::int64_t& now_ns) noexcept {
        std::size_t room = 0;
        std::uint8_t* const into = decoder_.space(room);
        if (room > budget) room = budget;
        int failed = 0;
        const ssize_t count = socket_.receive(into, room, failed);
        now_ns = monotonic_now_ns();
        if (count < 0) {
            lose(failed);
        } else if (count > 0) {
            decoder_.received(static_cast<std::size_t>(count));
            budget -= static_cast<std::size_t>(count);
        } else if (link_ == Link::subscribing && now_ns >= attempt_ends_ns_) {
            lose("the server did not answer the request to subscribe");
        }
        return count;
    }

    /// The next message received; a server that breaks the framing is left.
    FrameDecoder::Found next(Frame& frame, std::string_view& text) noexcept {
        const FrameDecoder::Found found = decoder_.next(frame, text);
        if (found == FrameDecoder::Found::broken) {
            const char* const reason = decoder_.reason();
            complain("the server sent ").add(reason).add(": is that ethercat-server?");
            drop();
        }
        return found;
    }

    /// Wait for the next step; as `Socket::wait`.
    bool wait(std::int64_t until_ns) const noexcept { return socket_.wait(link_ == Link::connecting, until_ns); }

    void is_shutting_down() noexcept { shutting_down_ = true; }

    // -- the end

    /// The connection is over; `why` is a part of a sentence.
    void lose(const char* why) noexcept {
        complain(why);
        drop();
    }
    void lose(int error_number) noexcept {
        if (error_number == 0)
            complain(shutting_down_ ? "the server was shut down" : "the server closed the connection");
        else
            describe_errno(complain(""), error_number);
        drop();
    }

    /// Over for good, until `resolve`.
    void close() noexcept {
        lose("closed by this program");
        socket_.close();
        addresses_.count = 0;
    }

    void drop() noexcept {
        if (!closes_late_) socket_.close();  // else the next step closes it: not a call of the control loop
        decoder_.reset();
        link_ = Link::down;
        shutting_down_ = false;
    }

    /// Begin the error anew: which server, then what is wrong with it.
    Message& complain(std::string_view what) noexcept {
        error_.clear();
        return error_.add(host_).add(" port ").add(std::int64_t{port_}).add(": ").add(what);
    }
    /// The error is this text, about no connection.
    Message& set_error() noexcept {
        error_.clear();
        return error_;
    }

private:
    static constexpr std::int64_t kAttemptNs = 2'000'000'000;

    void finish_connecting(std::int64_t now_ns) noexcept {
        int failed = 0;
        if (!socket_.connected(failed)) {
            if (failed != 0)
                lose(failed);
            else if (now_ns >= attempt_ends_ns_)
                lose(ETIMEDOUT);
            return;
        }
        if (!socket_.send(subscribe_)) return lose("the request to subscribe could not be sent");
        link_ = Link::subscribing;
    }

    std::string host_;
    std::uint16_t port_;
    int receive_buffer_;
    nanoseconds reconnect_every_;
    bool closes_late_;
    std::string subscribe_;
    FrameDecoder decoder_;
    Socket socket_;
    Addresses addresses_;
    Message error_;
    Link link_ = Link::down;
    std::size_t next_address_ = 0;
    std::int64_t attempt_ends_ns_ = 0, retry_at_ns_ = 0;
    bool shutting_down_ = false;
};

}  // namespace detail

}  // namespace bota_ethercat

#endif  // BOTA_ETHERCAT_CONNECTION_HPP
