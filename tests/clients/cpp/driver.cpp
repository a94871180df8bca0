// Runs the C++ client for tests: a command per line on standard input, and for each a line of JSON on standard output.
//
//   new [OPTION=VALUE ...]    another client; the one before is gone
//   now NS                    it is this time, of all clocks, from now on
//   moved                     the same client, moved to another place and back
//   connect MS | reconnect | close | latest [POSITION] | peek [POSITION] | next MS
//   server [HOST:PORT]        which one a program uses that is given this, or nothing
//   info [POSITION] | ask REQUEST | describe | tare SAMPLES FX FY FZ MX MY MZ
//
// Built with ASan, whose hook counts what `latest` and `next` allocate.
#include <bota_ethercat.hpp>
#include <bota_ethercat/world.hpp>

#include <cinttypes>
#include <cstdlib>
#include <iostream>
#include <optional>
#include <sstream>

#include "decode.hpp"
#include "json_text.hpp"

static std::size_t allocations = 0;

// Of ASan's runtime; g++ does not always come with <sanitizer/allocator_interface.h>.
extern "C" int __sanitizer_install_malloc_and_free_hooks(void (*)(const volatile void*, std::size_t), void (*)(const volatile void*));

// System calls of the client, by the linker's --wrap; `WRAPPED` in cpp_programs.py has their names.
static std::size_t receives = 0, other_calls = 0;
#define WRAPPED(result, name, counter, parameters, ...) \
    extern "C" result __real_##name parameters;         \
    extern "C" result __wrap_##name parameters { return ++counter, __real_##name(__VA_ARGS__); }
WRAPPED(int, socket, other_calls, (int domain, int type, int protocol), domain, type, protocol)
WRAPPED(int, connect, other_calls, (int fd, const sockaddr* address, socklen_t length), fd, address, length)
WRAPPED(int, close, other_calls, (int fd), fd)
WRAPPED(int, poll, other_calls, (pollfd* all, nfds_t count, int timeout), all, count, timeout)
WRAPPED(int, ppoll, other_calls, (pollfd* all, nfds_t count, const timespec* timeout, const sigset_t* mask), all, count, timeout, mask)
WRAPPED(int, setsockopt, other_calls, (int fd, int level, int what, const void* value, socklen_t size), fd, level, what, value, size)
WRAPPED(int, getsockopt, other_calls, (int fd, int level, int what, void* value, socklen_t* size), fd, level, what, value, size)
WRAPPED(ssize_t, send, other_calls, (int fd, const void* bytes, size_t size, int flags), fd, bytes, size, flags)
// Time stands still once the test has said what time it is.
static std::int64_t set_ns = 0;
extern "C" int __real_clock_gettime(clockid_t clock, timespec* now);
extern "C" int __wrap_clock_gettime(clockid_t clock, timespec* now) {
    if (set_ns == 0) return __real_clock_gettime(clock, now);
    *now = {static_cast<time_t>(set_ns / 1'000'000'000), static_cast<long>(set_ns % 1'000'000'000)};
    return 0;
}
WRAPPED(ssize_t, recv, receives, (int fd, void* into, size_t size, int flags), fd, into, size, flags)

namespace {

using namespace bota_ethercat;

std::size_t allocated = 0;           // in calls that promise not to
std::size_t received = 0, called = 0;  // in the same calls

template <typename Call>
Reading watched(Call&& call) {
    const std::size_t before = allocations, receives_before = receives, calls_before = other_calls;
    const Reading reading = call();
    allocated += allocations - before;
    received += receives - receives_before;
    called += other_calls - calls_before;
    return reading;
}

/// Its enumerator; null for a number that is none. -Wswitch: no enumerator is missing here.
const char* name(Condition condition) {
#define NAMED(name) case Condition::name: return #name;
    switch (condition) {
        NAMED(fresh) NAMED(saturated) NAMED(not_finite) NAMED(late) NAMED(bad_clock)
        NAMED(repeated) NAMED(invalid) NAMED(silent) NAMED(sensor_lost) NAMED(disconnected)
    }
    return nullptr;
}

/// What the thread was given, and what it has.
void real_time(int priority, int cpu) {
    const Scheduling given = make_real_time(priority, cpu, true);
    sched_param has{};
    sched_getparam(0, &has);
    std::printf("%d %d %d %d %d\n%s\n", sched_getscheduler(0), has.sched_priority, given.priority, given.cpu, given.memory_locked,
                given.refused.c_str());
}

void conditions() {
    for (int number = 0; number < 256; ++number)
        if (const auto condition = static_cast<Condition>(number); name(condition) != nullptr)
            std::printf("%d %s %s\n", number, name(condition), to_string(condition));
}

/// As Python's JSON has it.
void print(double number) {
    if (is_finite(number))
        std::printf("%.17g", number);
    else
        std::printf("%s", is_nan(number) ? "NaN" : number > 0.0 ? "Infinity" : "-Infinity");
}

template <std::size_t Size>
void print(const char* key, const std::array<double, Size>& numbers) {
    std::printf(",\"%s\":", key);
    for (std::size_t i = 0; i < Size; ++i) {
        std::printf("%c", i == 0 ? '[' : ',');
        print(numbers[i]);
    }
    std::printf("]");
}

void print(const Reading& r) {
    std::printf("{\"has_sample\":%s,\"is_new\":%s,\"fresh\":%s,\"condition\":\"%s\",\"sensor\":%u,\"flags\":%u,\"wkc\":%u",
                yes(r.has_sample), yes(r.is_new), yes(r.fresh()), name(r.condition), unsigned{r.sensor}, unsigned{r.flags},
                unsigned{r.wkc});
    std::printf(",\"sequence\":%" PRIu64 ",\"stamp_ns\":%" PRIu64 ",\"monotonic_ns\":%" PRIu64 ",\"received_ns\":%" PRId64
                ",\"age_ns\":%" PRId64 ",\"age_is_lower_bound\":%s",
                r.sequence, r.stamp_ns, r.monotonic_ns, r.received_ns, r.age_ns, yes(r.age_is_lower_bound));
    std::printf(",\"gap\":%s,\"withheld\":%" PRIu64 ",\"lost\":%" PRIu64 ",\"passed_over\":%" PRIu64 ",\"warnings_seen\":%" PRIu32
                ",\"connection\":%" PRIu32 ",\"more_waits\":%s",
                yes(r.gap), r.withheld, r.lost, r.passed_over, r.warnings_seen, r.connection, yes(r.more_waits));
    std::printf(",\"measured_ns\":[");
    for (const Channel channel : {Channel::force_torque, Channel::acceleration, Channel::angular_rate}) {
        const auto measured_ns = r.measured_ns(channel);
        std::printf("%s%s", channel == Channel::force_torque ? "" : ",", measured_ns ? std::to_string(*measured_ns).c_str() : "null");
    }
    std::printf("]");
    print("array", r.sample.array());
    std::printf(",\"temperature\":");
    print(r.sample.temperature);
    std::printf("}");
}

Options options_from(std::istringstream& words) {
    Options options;
    for (std::string word; words >> word;) {
        const std::string key = word.substr(0, word.find('=')), value = word.substr(word.find('=') + 1);
        const auto number = [&] { return std::stoll(value); };
        if (key == "host") options.host = value;
        else if (key == "port") options.port = static_cast<std::uint16_t>(number());
        else if (key.rfind("sensor", 0) == 0) options.sensors.push_back(static_cast<std::uint8_t>(number()));
        else if (key == "every") options.every = static_cast<std::uint32_t>(number());
        else if (key == "fresh_only") options.fresh_only = number() != 0;
        else if (key == "max_age_ms") options.max_age = std::chrono::milliseconds(number());
        else if (key == "reconnect") options.reconnect = value == "when_told" ? Reconnect::when_told : Reconnect::by_itself;
        else if (key == "judge_imu") options.judge_imu = number() != 0;
        else if (key == "reconnect_every_ms") options.reconnect_every = std::chrono::milliseconds(number());
        else if (key == "max_bytes_per_call") options.max_bytes_per_call = static_cast<std::size_t>(number());
        else if (key == "receive_buffer") options.receive_buffer = static_cast<int>(number());
        else std::exit(2);
    }
    return options;
}

void info(const Client& client, std::uint8_t place) {
    const Counters c = client.counters(place);
    constexpr const char* kLinks[] = {"down", "connecting", "subscribing", "up"};
    std::printf("{\"link\":\"%s\",\"error\":%s,\"connections\":%u,\"reconfigurations\":%u,\"refused\":%s,\"bad_messages\":%" PRIu64
                ",\"allocated\":%zu,\"allocates\":%s,\"receives\":%zu,\"other_calls\":%zu,\"fd\":%d",
                kLinks[static_cast<int>(client.link())], quoted(client.error()).c_str(), client.connections(),
                client.reconfigurations(), yes(client.refused()), client.bad_messages(), allocated, yes(allocations > 0), received, called, client.fd());
    std::printf(",\"frames\":%" PRIu64 ",\"samples\":%" PRIu64 ",\"repeated\":%" PRIu64 ",\"invalid\":%" PRIu64 ",\"gaps\":%" PRIu64
                ",\"withheld\":%" PRIu64 ",\"skipped\":%" PRIu64 ",\"passed_over\":%" PRIu64 ",\"names\":[",
                c.frames(), c.samples, c.repeated, c.invalid, c.gaps, c.withheld, c.skipped, c.passed_over);
    for (std::size_t i = 0; i < client.description().sensor_count; ++i)
        std::printf("%s%s", i ? "," : "", quoted(client.description().sensors[i].name.view()).c_str());
    std::printf("]}");
}

void print(const Control& control, bool ok) {
    std::printf("\"ok\":%s,\"error\":%s,\"code\":%s,\"abort_code\":%u}", yes(ok), quoted(control.error()).c_str(),
                quoted(control.error_code()).c_str(), control.abort_code());
}

}  // namespace

int main(int argc, char** argv) {
    if (argc > 1 && std::string_view(argv[1]) == "decode") return decode(argc > 2 && std::string_view(argv[2]) == "accounting");
    if (argc > 3 && std::string_view(argv[1]) == "real_time") return real_time(std::atoi(argv[2]), std::atoi(argv[3])), 0;
    if (argc > 1 && std::string_view(argv[1]) == "conditions") return conditions(), 0;
    if (argc > 2 && std::string_view(argv[1]) == "world") return !World(argv[2]).send(0.5, {{1, 2, 3, 4, 5, 6}, {7, 8, 9}, {10, 11, 12}, 13}, 2);
    __sanitizer_install_malloc_and_free_hooks([](const volatile void*, std::size_t) { ++allocations; }, [](const volatile void*) {});
    std::optional<Client> maybe_client;
    std::optional<Control> maybe_control;
    for (std::string line, command; std::getline(std::cin, line);) {
        std::istringstream words(line);
        words >> command;
        if (command == "new") {
            const Options options = options_from(words);
            maybe_client.emplace(options);
            maybe_control.emplace(options.host, options.port);
            allocated = received = called = 0;
            set_ns = 0;
            continue;
        }
        if (command == "now") {
            words >> set_ns;
            continue;
        }
        if (command == "server") {
            std::string given;
            words >> given;
            Options options;
            const bool ok = choose_server(given.empty() ? nullptr : given.c_str(), options);
            std::printf("[%s,%s,%u]\n", yes(ok), quoted(options.host.c_str()).c_str(), unsigned{options.port});
            std::fflush(stdout);
            continue;
        }
        if (!maybe_client) return 2;
        Client& client = *maybe_client;
        Control& control = *maybe_control;
        long number = 0;
        if (command != "ask") words >> number;
        const auto place = static_cast<std::uint8_t>(number);
        if (command == "connect") {
            const bool ok = client.connect(std::chrono::milliseconds(number));
            std::printf("{\"ok\":%s,\"error\":%s}", yes(ok), quoted(client.error()).c_str());
        } else if (command == "reconnect") {
            std::printf("%s", yes(client.reconnect()));
        } else if (command == "moved") {
            Client other("nowhere", 1);
            other = std::move(client);
            maybe_client.emplace(std::move(other));
            std::printf("{}");
        } else if (command == "close") {
            client.close();
            std::printf("{}");
        } else if (command == "latest") {
            print(watched([&] { return client.latest(place); }));
        } else if (command == "peek") {
            print(watched([&] { return client.peek(place); }));
        } else if (command == "next") {
            print(watched([&] { return client.next(std::chrono::milliseconds(number)); }));
        } else if (command == "info") {
            info(client, place);
        } else if (command == "ask") {
            const bool ok = control.ask(line.substr(4), std::chrono::seconds(5));
            const std::string_view reply = control.reply().text();
            std::printf("{\"reply\":%s,", reply.empty() ? "null" : std::string(reply).c_str());
            print(control, ok);
        } else if (command == "describe") {
            Description d;
            const bool ok = control.describe(d);
            std::printf("{\"sensors\":[");
            for (std::size_t i = 0; i < d.sensor_count; ++i) {
                const SensorInfo& s = d.sensors[i];
                std::printf("%s{\"sensor\":%u,\"serial\":%" PRIu64 ",\"pdo_size\":%u,\"rate_hz\":%g,\"name\":%s,\"hardware\":%s,"
                            "\"firmware\":%s,\"state\":%s}",
                            i ? "," : "", unsigned{s.sensor}, s.serial, s.pdo_size, s.rate_hz, quoted(s.name.view()).c_str(),
                            quoted(s.hardware.view()).c_str(), quoted(s.firmware.view()).c_str(), quoted(s.state.view()).c_str());
            }
            std::printf("],\"version\":%s,", quoted(d.version.view()).c_str());
            print(control, ok);
        } else if (command == "tare") {
            std::array<double, 6> target{};
            for (double& value : target)  // also nan and inf
                if (std::string word; words >> word) value = std::strtod(word.c_str(), nullptr);
            TareResult t;
            const bool ok = control.tare(t, 0, static_cast<unsigned>(number), target);
            std::printf("{\"done\":%s", yes(ok));
            print("old_offset", t.old_offset);
            print("new_offset", t.new_offset);
            print("residual", t.residual);
            print("deviation", t.deviation);
            std::printf(",");
            print(control, ok);
        } else {
            return 2;
        }
        std::printf("\n");
        std::fflush(stdout);
    }
    return 0;
}
