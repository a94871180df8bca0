// How old a sample is when the C++ client has it, beside a bare read of the same bytes.
//
//   cpp pair HZ SECONDS      a sender of stamped messages, in turns to a bare socket and to a Client
//   cpp server PORT SECONDS  ethercat-server's samples, in turns a quarter of a second long
//
// Whose turn it is and the pause before it are drawn at random: a strict beat would fall in with other beats of the
// machine, always for the same one of the two. Each is done twice: `waiting` (a blocking recv; Client::next) and `polling` (recv and Client::latest without pause).
// Output: a line for each age, `WAY WHO NANOSECONDS`.
#include <bota_ethercat.hpp>

#include <sys/prctl.h>
#include <sys/wait.h>

#include <cinttypes>
#include <csignal>
#include <cstdlib>

namespace {

using namespace bota_ethercat;

constexpr std::size_t kSize = 94;  // a DATA message with 61 bytes of process data
enum Way { waiting, polling };
enum Who { bare, client };
constexpr const char* kWays[] = {"waiting", "polling"};
constexpr const char* kWho[] = {"bare", "client"};

struct Age {
    Way way;
    Who who;
    std::int64_t ns;
};
std::vector<Age> ages;
std::size_t noted[2][2] = {};

[[noreturn]] void fail(const char* what) {
    std::fprintf(stderr, "benchmark: %s\n", what);
    std::exit(1);
}

int dial(std::uint16_t port) {
    const int fd = ::socket(AF_INET, SOCK_STREAM, 0);
    sockaddr_in address{};
    address.sin_family = AF_INET;
    address.sin_port = htons(port);
    address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    if (connect(fd, reinterpret_cast<sockaddr*>(&address), sizeof address) != 0) fail("the bare socket could not connect");
    return fd;
}

/// The obvious client: knows the head of a message and where its stamp is, and nothing else.
class Bare {
public:
    explicit Bare(int fd) : fd_(fd) {}
    ~Bare() { ::close(fd_); }
    Bare(const Bare&) = delete;
    Bare& operator=(const Bare&) = delete;

    /// The stamp of the next message if it waits, of the newest one if it polls; 0 if there is none.
    std::uint64_t read(Way way) {
        std::uint64_t stamp = 0;
        if (way == waiting && take(stamp)) return stamp;
        if (start_ > 0) std::memmove(buffer_, buffer_ + start_, end_ - start_);
        end_ -= start_;
        start_ = 0;
        const ssize_t count = recv(fd_, buffer_ + end_, sizeof buffer_ - end_, way == polling ? MSG_DONTWAIT : 0);
        if (count == 0 || (count < 0 && errno != EAGAIN)) fail("the bare socket was closed");
        if (count > 0) end_ += static_cast<std::size_t>(count);
        while (take(stamp) && way == polling) {
        }
        return stamp;
    }

private:
    /// One message; `stamp` is left as it was by one that is no sample.
    bool take(std::uint64_t& stamp) {
        if (end_ - start_ < 4) return false;
        const std::size_t size = 4 + detail::big_endian<std::uint32_t>(buffer_ + start_);
        if (end_ - start_ < size) return false;
        if (size == kSize) stamp = detail::big_endian<std::uint64_t>(buffer_ + start_ + 21);
        start_ += size;
        return true;
    }

    int fd_;
    std::uint8_t buffer_[131072];
    std::size_t start_ = 0, end_ = 0;
};

/// Who gets the next message; the sender and the reader draw the same.
class Turns {
public:
    Who next() {
        state_ ^= state_ << 13, state_ ^= state_ >> 7, state_ ^= state_ << 17;
        return state_ >> 40 & 1 ? client : bare;
    }
    /// From 0.5 to 1.5, to go with the last turn.
    double pause() const { return 0.5 + static_cast<double>(state_ >> 44) / (1 << 20); }

private:
    std::uint64_t state_ = 88172645463325252u;
};

void note(Way way, Who who, std::uint64_t stamp) {
    ages.push_back({way, who, monotonic_now_ns() - static_cast<std::int64_t>(stamp)});
    ++noted[way][who];
}

void take_bare(Bare& bare_socket, Way way) {
    for (;;) {
        const std::uint64_t stamp = bare_socket.read(way);
        if (stamp != 0) return note(way, bare, stamp);
    }
}

void take_client(Client& sensor, Way way) {
    for (;;) {
        const Reading reading = way == polling ? sensor.latest() : sensor.next(std::chrono::seconds(5));
        if (reading.is_new) return note(way, client, reading.monotonic_ns);
        if (!sensor.connected()) fail(sensor.error());
    }
}

/// The other end: sends a stamped message at each deadline, in turns to both, until it is killed.
[[noreturn]] void send_for_ever(int listener, double hz) {
    prctl(PR_SET_PDEATHSIG, SIGKILL);
    prctl(PR_SET_TIMERSLACK, 1000UL);
    const int one = 1;
    int to[2];
    for (int& fd : to) {
        fd = accept(listener, nullptr, nullptr);
        setsockopt(fd, IPPROTO_TCP, TCP_NODELAY, &one, sizeof one);
    }
    char request[4096];
    if (recv(to[client], request, sizeof request, 0) <= 0) std::exit(1);
    const std::string reply = encode_json("{\"reply\":\"subscribe\",\"ok\":true,\"protocol\":1,\"sensors\":[]}");
    (void)send(to[client], reply.data(), reply.size(), MSG_NOSIGNAL);
    std::uint8_t message[kSize] = {0, 0, 0, kSize - 4, 1};
    std::int64_t due = monotonic_now_ns();
    Turns turns;
    for (std::uint64_t number = 1;; ++number) {
        const Who who = turns.next();
        due += static_cast<std::int64_t>(1e9 / hz * turns.pause());
        const timespec at{static_cast<time_t>(due / 1'000'000'000), static_cast<long>(due % 1'000'000'000)};
        clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &at, nullptr);
        const auto put = [&](std::size_t offset, std::uint64_t value) {
            for (std::size_t i = 0; i < 8; ++i) message[offset + i] = static_cast<std::uint8_t>(value >> (56 - 8 * i));
        };
        put(5, number);
        put(21, static_cast<std::uint64_t>(monotonic_now_ns()));
        if (send(to[who], message, sizeof message, MSG_NOSIGNAL) != static_cast<ssize_t>(kSize)) std::exit(0);
    }
}

void pair(double hz, double seconds) {
    const int listener = ::socket(AF_INET, SOCK_STREAM, 0);
    sockaddr_in address{};
    address.sin_family = AF_INET;
    address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    socklen_t size = sizeof address;
    if (bind(listener, reinterpret_cast<sockaddr*>(&address), size) != 0 || listen(listener, 2) != 0 ||
        getsockname(listener, reinterpret_cast<sockaddr*>(&address), &size) != 0)
        fail("no port for the sender");
    const pid_t sender = fork();
    if (sender == 0) send_for_ever(listener, hz);
    Bare bare_socket(dial(ntohs(address.sin_port)));
    Client sensor("127.0.0.1", ntohs(address.sin_port));
    if (!sensor.connect()) fail(sensor.error());
    const auto until = [&] { return monotonic_now_ns() + static_cast<std::int64_t>(seconds * 1e9); };
    // A busy machine may let all the time pass before there is one age of each.
    const auto goes_on = [&](Way way, std::int64_t end) { return monotonic_now_ns() < end || !noted[way][bare] || !noted[way][client]; };
    Turns turns;
    for (const std::int64_t end = until(); goes_on(waiting, end);) {
        if (turns.next() == bare)
            take_bare(bare_socket, waiting);
        else
            take_client(sensor, waiting);
    }
    for (const std::int64_t end = until(); goes_on(polling, end);) {
        if (const std::uint64_t stamp = bare_socket.read(polling)) note(polling, bare, stamp);
        const Reading reading = sensor.latest();
        if (reading.is_new) note(polling, client, reading.monotonic_ns);
    }
    if (!sensor.connected()) fail(sensor.error());
    kill(sender, SIGKILL);
    waitpid(sender, nullptr, 0);
}

void server(std::uint16_t port, double seconds) {
    const std::string request = encode_json("{\"action\":\"subscribe\"}");
    const std::int64_t end = monotonic_now_ns() + static_cast<std::int64_t>(seconds * 1e9);
    for (int turn = 0; monotonic_now_ns() < end; ++turn) {
        const Way way = turn % 4 < 2 ? waiting : polling;
        const std::int64_t turn_ends = monotonic_now_ns() + 250'000'000;
        const std::size_t before = ages.size();
        if (turn % 2 == 0) {
            const int fd = dial(port);
            (void)send(fd, request.data(), request.size(), MSG_NOSIGNAL);
            std::uint8_t head[4];
            if (recv(fd, head, sizeof head, MSG_WAITALL) != 4) fail("the server did not answer");
            std::vector<std::uint8_t> reply(detail::big_endian<std::uint32_t>(head));
            if (recv(fd, reply.data(), reply.size(), MSG_WAITALL) < 0) fail("the server did not answer");
            Bare bare_socket(fd);
            while (monotonic_now_ns() < turn_ends) take_bare(bare_socket, way);
        } else {
            Client sensor("127.0.0.1", port);
            if (!sensor.connect()) fail(sensor.error());
            while (monotonic_now_ns() < turn_ends) take_client(sensor, way);
        }
        const auto first = ages.begin() + static_cast<std::ptrdiff_t>(before);  // the first ones came while it connected
        ages.erase(first, ages.size() - before > 20 ? first + 20 : ages.end());
    }
}

}  // namespace

int main(int argc, char** argv) {
    prctl(PR_SET_TIMERSLACK, 1000UL);
    ages.reserve(1 << 21);
    if (argc == 4 && std::strcmp(argv[1], "pair") == 0)
        pair(std::atof(argv[2]), std::atof(argv[3]));
    else if (argc == 4 && std::strcmp(argv[1], "server") == 0)
        server(static_cast<std::uint16_t>(std::atoi(argv[2])), std::atof(argv[3]));
    else
        fail("usage: pair HZ SECONDS | server PORT SECONDS");
    for (const Age& age : ages) std::printf("%s %s %" PRId64 "\n", kWays[age.way], kWho[age.who], age.ns);
    return 0;
}
