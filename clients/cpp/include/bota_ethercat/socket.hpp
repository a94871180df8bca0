// A non-blocking TCP socket, and the addresses of a host.
#ifndef BOTA_ETHERCAT_SOCKET_HPP
#define BOTA_ETHERCAT_SOCKET_HPP

#include <netdb.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <sys/socket.h>
#include <sys/types.h>
#include <time.h>
#include <unistd.h>

#include <array>
#include <cerrno>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <string>
#include <string_view>
#include <utility>

#include "bota_ethercat/text.hpp"

namespace bota_ethercat {

namespace detail {

using Message = Text<320>;

/// What a failed connection comes to, in words. Not strerror: that may allocate.
inline void describe_errno(Message& text, int number) noexcept {
    switch (number) {
        case ECONNREFUSED: text.add("nobody listens there: start ethercat-server, or name its port"); break;
        case ECONNRESET: case EPIPE: text.add("the server reset the connection"); break;
        case ETIMEDOUT: text.add("no answer"); break;
        case EHOSTUNREACH: case ENETUNREACH: text.add("no route to that host"); break;
        case EMFILE: case ENFILE: text.add("too many open files"); break;
        default: text.add("error ").add(std::int64_t{number});
    }
}

/// Where a server may be: the addresses of a host name, asked for once.
struct Addresses {
    std::array<sockaddr_storage, 8> address{};
    std::array<socklen_t, 8> length{};
    std::size_t count = 0;

    /// May wait for name servers.
    bool resolve(const std::string& host, std::uint16_t port, Message& error) noexcept {
        addrinfo wanted{}, *found = nullptr;
        wanted.ai_socktype = SOCK_STREAM;
        Text<8> service;
        service.add(std::int64_t{port});
        const int result = getaddrinfo(host.c_str(), service.c_str(), &wanted, &found);
        count = 0;
        if (result != 0) {
            error.clear();
            error.add("no address for ").add(host).add(": ").add(gai_strerror(result));
            return false;
        }
        for (const addrinfo* each = found; each && count < address.size(); each = each->ai_next) {
            if (each->ai_addrlen > sizeof(sockaddr_storage)) continue;
            std::memcpy(&address[count], each->ai_addr, each->ai_addrlen);
            length[count++] = each->ai_addrlen;
        }
        freeaddrinfo(found);
        return count > 0;
    }
};

/// A non-blocking TCP socket; closes itself.
class Socket {
public:
    Socket() = default;
    Socket(Socket&& other) noexcept : fd_(std::exchange(other.fd_, -1)) {}
    Socket& operator=(Socket&& other) noexcept {
        if (this != &other) close(), fd_ = std::exchange(other.fd_, -1);
        return *this;
    }
    ~Socket() { close(); }

    int fd() const noexcept { return fd_; }
    bool open() const noexcept { return fd_ >= 0; }
    void close() noexcept {
        if (fd_ >= 0) ::close(fd_);
        fd_ = -1;
    }

    /// Begin to connect; 0 or the errno. `connected` tells when it is done.
    int begin(const sockaddr_storage& address, socklen_t length, int receive_buffer) noexcept {
        close();
        fd_ = ::socket(address.ss_family, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
        if (fd_ < 0) return errno;
        set(IPPROTO_TCP, TCP_NODELAY, 1);
        // A host that is gone without a word is noticed within some 5 s. A stopped server is not gone.
        set(SOL_SOCKET, SO_KEEPALIVE, 1);
        set(IPPROTO_TCP, TCP_KEEPIDLE, 2);
        set(IPPROTO_TCP, TCP_KEEPINTVL, 1);
        set(IPPROTO_TCP, TCP_KEEPCNT, 3);
        // With less TCP needs hundreds of milliseconds to get going again after a stall.
        if (receive_buffer > 0) set(SOL_SOCKET, SO_RCVBUF, receive_buffer < 16384 ? 16384 : receive_buffer);
        if (::connect(fd_, reinterpret_cast<const sockaddr*>(&address), length) == 0 || errno == EINPROGRESS) return 0;
        const int error = errno;
        close();
        return error;
    }

    /// Whether the connection is there; `error` is its errno if it failed.
    bool connected(int& error) noexcept {
        error = 0;
        pollfd one{fd_, POLLOUT, 0};
        if (::poll(&one, 1, 0) <= 0) return false;
        socklen_t size = sizeof error;
        if (getsockopt(fd_, SOL_SOCKET, SO_ERROR, &error, &size) != 0) error = errno;
        return error == 0;
    }

    /// Send all of a short message at once; false if that is not possible. A fresh connection has room for it.
    bool send(std::string_view message) noexcept {
        return ::send(fd_, message.data(), message.size(), MSG_NOSIGNAL) == static_cast<ssize_t>(message.size());
    }

    /// Bytes received; 0: there are none now; -1: the connection is over, `error` is its errno, 0 = closed.
    ssize_t receive(std::uint8_t* into, std::size_t size, int& error) noexcept {
        const ssize_t count = ::recv(fd_, into, size, MSG_DONTWAIT);
        if (count > 0) return count;
        error = count == 0 ? 0 : errno;
        return count < 0 && (error == EAGAIN || error == EWOULDBLOCK || error == EINTR) ? 0 : -1;
    }

    /// Wait until there is something to do, at most until CLOCK_MONOTONIC is `until_ns`; false if a signal came.
    bool wait(bool to_write, std::int64_t until_ns) const noexcept {
        const std::int64_t left = until_ns - monotonic_now_ns();
        if (left <= 0) return true;
        const timespec timeout{static_cast<time_t>(left / 1'000'000'000), static_cast<long>(left % 1'000'000'000)};
        pollfd one{fd_, static_cast<short>(to_write ? POLLOUT : POLLIN), 0};
        return ::ppoll(&one, open() ? 1 : 0, &timeout, nullptr) >= 0 || errno != EINTR;
    }

private:
    void set(int level, int name, int value) noexcept { setsockopt(fd_, level, name, &value, sizeof value); }

    int fd_ = -1;
};

}  // namespace detail

}  // namespace bota_ethercat

#endif  // BOTA_ETHERCAT_SOCKET_HPP
