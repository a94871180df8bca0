// Runs the C++ client for tests: a command per line on standard input, and for each a line of JSON on standard output.
//
//   new [OPTION=VALUE ...]    another client; the one before is gone
//   now NS                    it is this time, of all clocks, from now on
//   moved                     the same client, moved to another place and back
//   connect MS | reconnect | close | latest [POSITION] | peek [POSITION] | next MS
//   server [HOST:PORT]        which one a program uses that is given this, or nothing
//   info [POSITION] | ask REQUEST | describe | tare SAMPLES FX FY FZ MX MY MZ
//
// `driver decode` reads streams of bytes, `driver decode accounting` streams of frames.
//
// In: a line for each stream, `MAX_JSON_LENGTH UNITS CHUNK CHUNK ...`; units `g_dps` or `si`, chunks hexadecimal.
// Out: a line for each outcome, then an empty one.
//   D sequence stamp_ns monotonic_ns sensor flags wkc size status warnings saturated x3, 13 numbers, then 4 or `-`
//   J the JSON object, in ASCII         B a JSON message that was refused         X the framing is broken
//
// Accounting, in: `EVERY FRESH_ONLY RATE_HZ`, then SEQUENCE,MONOTONIC_NS,FLAGS for each frame, or `begin`.
// Out: a line with the kind of each frame, then the counts.
//
// `driver contact` tells contact of wrenches on standard input, a line each: a
// surface (start, end, radius, normal or zeros), an uncertainty (force, torque, tool, center, spin, motion), force, torque,
// angular rate and acceleration. For each a line: `update` of a detector that was not in contact, then of one that was, and
// what `locate` says, as numbers.
//
// Built with ASan, whose hook counts what `latest` and `next` allocate.
#include <bota_ethercat.hpp>
#include <bota_ethercat/world.hpp>

#include <cinttypes>
#include <cstdlib>
#include <iostream>
#include <optional>
#include <sstream>

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

void print_text(json::Value text) {
    std::putchar('"');
    text.for_each_character([](char32_t c) {
        if (c >= 0x10000) {
            c -= 0x10000;
            std::printf("\\u%04x\\u%04x", 0xD800u + static_cast<unsigned>(c >> 10), 0xDC00u + static_cast<unsigned>(c & 0x3FF));
        } else if (c < 0x20 || c > 0x7E || c == U'"' || c == U'\\') {
            std::printf("\\u%04x", static_cast<unsigned>(c));
        } else {
            std::putchar(static_cast<int>(c));
        }
    });
    std::putchar('"');
}

// Recursive, as no client needs to be: the depth was checked.
void print_value(json::Value value) {
    if (value.is_string()) return print_text(value);
    if (!value.is_object() && !value.is_array()) {
        const std::string_view text = value.text();
        std::fwrite(text.data(), 1, text.size(), stdout);
        return;
    }
    std::putchar(value.is_object() ? '{' : '[');
    const char* separator = "";
    value.for_each([&](json::Value name, json::Value item) {
        std::fputs(separator, stdout);
        if (value.is_object()) print_value(name), std::putchar(':');
        print_value(item);
        separator = ",";
    });
    std::putchar(value.is_object() ? '}' : ']');
}

void print_frame(const Frame& frame, ImuUnits units) {
    Sample sample;
    if (!decode(frame.process_data, frame.size, units, sample)) std::abort();
    std::printf("D %" PRIu64 " %" PRIu64 " %" PRIu64 " %u %u %u %zu %u %" PRIu32 " %u %u %u", frame.sequence, frame.stamp_ns,
                frame.monotonic_ns, unsigned{frame.sensor}, unsigned{frame.flags}, unsigned{frame.wkc}, frame.size,
                unsigned{sample.status}, sample.warnings, unsigned{sample.force_torque_saturated},
                unsigned{sample.acceleration_saturated}, unsigned{sample.angular_rate_saturated});
    for (const double number : sample.array()) std::printf(" %a", number);
    std::printf(" %a", sample.temperature);
    if (sample.has_orientation)
        for (const double number : sample.orientation) std::printf(" %a", number);
    else
        std::printf(" -");
    std::printf(" %s\n", sample.is_finite() ? "finite" : "not-finite");
}

/// Print every message there is; false once the framing is broken.
bool drain(FrameDecoder& decoder, ImuUnits units) {
    Frame frame;
    std::string_view text;
    for (;;) {
        switch (decoder.next(frame, text)) {
            case FrameDecoder::Found::nothing: return true;
            case FrameDecoder::Found::broken: return false;
            case FrameDecoder::Found::data: print_frame(frame, units); break;
            case FrameDecoder::Found::json: {
                // A copy of just this size, so that reading behind its end is found.
                const std::unique_ptr<char[]> copy(new char[text.size()]);
                std::memcpy(copy.get(), text.data(), text.size());
                const std::string_view same(copy.get(), text.size());
                if (!json::is_object(same)) {
                    std::printf("B\n");
                    break;
                }
                std::printf("J ");
                print_value(json::Value(same));
                std::printf("\n");
            }
        }
    }
}

std::string from_hex(const std::string& digits) {
    std::string bytes;
    for (std::size_t i = 0; i + 1 < digits.size(); i += 2) {
        unsigned byte = 0;
        std::from_chars(digits.data() + i, digits.data() + i + 2, byte, 16);
        bytes.push_back(static_cast<char>(byte));
    }
    return bytes;
}

void account(const std::string& line) {
    constexpr const char* kKinds[] = {"new", "repeated", "invalid", "old"};
    std::istringstream words(line);
    StreamAccounting accounting;
    words >> accounting.every >> accounting.fresh_only >> accounting.rate_hz;
    for (std::string word; words >> word;) {
        if (word == "begin") {
            accounting.begin();
            continue;
        }
        std::istringstream numbers(word);
        std::uint64_t sequence = 0, monotonic_ns = 0;
        unsigned flags = 0;
        char comma = 0;
        numbers >> sequence >> comma >> monotonic_ns >> comma >> flags;
        std::printf("%s ", kKinds[static_cast<int>(accounting.count(sequence, monotonic_ns, static_cast<std::uint8_t>(flags)))]);
    }
    const StreamCounts& c = accounting.counts;
    for (const std::uint64_t count : {c.samples, c.repeated, c.invalid, c.old, c.restarts, c.gaps, c.withheld, c.lost, c.skipped})
        std::printf("%" PRIu64 " ", count);
    std::printf("\n");
}

int decode(bool accounting) {
    std::ios::sync_with_stdio(false);
    if (accounting) {
        for (std::string line; std::getline(std::cin, line);) account(line);
        return 0;
    }
    for (std::string line; std::getline(std::cin, line);) {
        std::istringstream words(line);
        std::size_t max_json_length = 0;
        std::string units_name, chunk;
        words >> max_json_length >> units_name;
        const ImuUnits units = units_name == "si" ? ImuUnits::si : ImuUnits::g_dps;
        FrameDecoder decoder(max_json_length);
        bool whole = true;
        while (whole && words >> chunk) {
            const std::string bytes = from_hex(chunk);
            for (std::size_t at = 0; whole && at < bytes.size();) {
                std::size_t room = 0;
                std::uint8_t* const into = decoder.space(room);
                const std::size_t count = std::min(room, bytes.size() - at);
                std::memcpy(into, bytes.data() + at, count);
                decoder.received(count);
                at += count;
                whole = drain(decoder, units);
            }
        }
        if (!whole) std::printf("X\n");
        std::printf("\n");
    }
    return 0;
}

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

Vector3 vector(std::istream& in) {
    Vector3 v{};
    in >> v[0] >> v[1] >> v[2];
    return v;
}

void contact() {
    for (std::string line; std::getline(std::cin, line);) {
        std::istringstream in(line);
        Surface surface;
        surface.start = vector(in), surface.end = vector(in), in >> surface.radius;
        if (const Vector3 normal = vector(in); normal != Vector3{}) surface.normal = normal;
        Uncertainty known;
        in >> known.force, known.torque = vector(in), in >> known.tool, known.center = vector(in), in >> known.spin >> known.motion;
        const Vector3 force = vector(in), torque = vector(in), rate = vector(in), spin = vector(in);
        ContactDetector one(surface, known, 800.0), other(surface, known, 800.0, 0.394, 0.5);
        (void)other.update({0, 0, 1000}, {});
        const bool began = one.update(force, torque, rate, spin), stayed = other.update(force, torque, rate, spin);
        const Contact found = other.locate(force, torque, rate, spin);
        std::printf("%d %d %d %d", began, stayed, static_cast<int>(found.why), found.is_press);
        for (const Vector3& each : {found.point, found.center, found.normal, found.u, found.v})
            std::printf(" %.17g %.17g %.17g", each[0], each[1], each[2]);
        std::printf(" %.17g %.17g %.17g\n", found.uu, found.uv, found.vv);
    }
}

std::string text_of(const Reading& r) {
    const auto measured_ns = [&r](Channel channel) { return json_text(r.measured_ns(channel)); };
    constexpr std::array channels{Channel::force_torque, Channel::acceleration, Channel::angular_rate};
    return Object()("has_sample", r.has_sample)("is_new", r.is_new)("fresh", r.fresh())("condition", name(r.condition))(
        "sensor", r.sensor)("flags", r.flags)("wkc", r.wkc)("sequence", r.sequence)("stamp_ns", r.stamp_ns)(
        "monotonic_ns", r.monotonic_ns)("received_ns", r.received_ns)("age_ns", r.age_ns)(
        "age_is_lower_bound", r.age_is_lower_bound)("gap", r.gap)("withheld", r.withheld)("lost", r.lost)(
        "passed_over", r.passed_over)("warnings_seen", r.warnings_seen)("connection", r.connection)("more_waits", r.more_waits)
        .raw("measured_ns", json_list(channels, measured_ns))("array", r.sample.array())("temperature", r.sample.temperature)
        .text();
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

std::string info(const Client& client, std::uint8_t place) {
    const Counters c = client.counters(place);
    constexpr const char* kLinks[] = {"down", "connecting", "subscribing", "up"};
    return Object()("link", kLinks[static_cast<int>(client.link())])("error", client.error())("connections", client.connections())(
        "reconfigurations", client.reconfigurations())("refused", client.refused())("bad_messages", client.bad_messages())(
        "allocated", allocated)("allocates", allocations > 0)("receives", received)("other_calls", called)("fd", client.fd())(
        "samples", c.samples)("sensor_count", client.description().sensor_count)
        .text();
}

std::string text_of(const SensorInfo& s) {
    return Object()("sensor", s.sensor)("serial", s.serial)("pdo_size", s.pdo_size)("rate_hz", s.rate_hz)("name", s.name)(
        "hardware", s.hardware)("firmware", s.firmware)("state", s.state).text();
}

std::string ended(Object told, const Control& control, bool ok) {
    return told("ok", ok)("error", control.error())("code", control.error_code())("abort_code", control.abort_code()).text();
}

}  // namespace

int main(int argc, char** argv) {
    if (argc > 1 && std::string_view(argv[1]) == "decode") return decode(argc > 2 && std::string_view(argv[2]) == "accounting");
    if (argc > 3 && std::string_view(argv[1]) == "real_time") return real_time(std::atoi(argv[2]), std::atoi(argv[3])), 0;
    if (argc > 1 && std::string_view(argv[1]) == "conditions") return conditions(), 0;
    if (argc > 1 && std::string_view(argv[1]) == "contact") return contact(), 0;
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
        if (command != "server" && !maybe_client) return 2;
        Client& client = *maybe_client;
        Control& control = *maybe_control;
        long number = 0;
        if (command != "ask" && command != "server") words >> number;
        const auto place = static_cast<std::uint8_t>(number);
        std::string told = "{}";
        if (command == "server") {
            std::string given;
            words >> given;
            Options options;
            const bool ok = choose_server(given.empty() ? nullptr : given.c_str(), options);
            told = "[" + json_text(ok) + "," + json_text(options.host) + "," + json_text(options.port) + "]";
        } else if (command == "connect") {
            const bool ok = client.connect(std::chrono::milliseconds(number));
            told = Object()("ok", ok)("error", client.error()).text();
        } else if (command == "reconnect") {
            told = json_text(client.reconnect());
        } else if (command == "moved") {
            Client other("nowhere", 1);
            other = std::move(client);
            maybe_client.emplace(std::move(other));
        } else if (command == "close") {
            client.close();
        } else if (command == "latest") {
            told = text_of(watched([&] { return client.latest(place); }));
        } else if (command == "peek") {
            told = text_of(watched([&] { return client.peek(place); }));
        } else if (command == "next") {
            told = text_of(watched([&] { return client.next(std::chrono::milliseconds(number)); }));
        } else if (command == "info") {
            told = info(client, place);
        } else if (command == "ask") {
            const bool ok = control.ask(line.substr(4), std::chrono::seconds(5));
            const std::string_view reply = control.reply().text();
            told = ended(Object().raw("reply", reply.empty() ? "null" : reply), control, ok);
        } else if (command == "describe") {
            Description d;
            const bool ok = control.describe(d);
            const std::vector<SensorInfo> sensors(d.sensors.begin(), d.sensors.begin() + static_cast<long>(d.sensor_count));
            const std::string rows = json_list(sensors, [](const SensorInfo& each) { return text_of(each); });
            told = ended(Object().raw("sensors", rows)("version", d.version), control, ok);
        } else if (command == "tare") {
            std::array<double, 6> target{};
            for (double& value : target)  // also nan and inf
                if (std::string word; words >> word) value = std::strtod(word.c_str(), nullptr);
            TareResult t;
            const bool ok = control.tare(t, 0, static_cast<unsigned>(number), target);
            told = ended(Object()("old_offset", t.old_offset)("new_offset", t.new_offset)("residual", t.residual)(
                             "deviation", t.deviation), control, ok);
        } else {
            return 2;
        }
        std::printf("%s\n", told.c_str());
        std::fflush(stdout);
    }
    return 0;
}
