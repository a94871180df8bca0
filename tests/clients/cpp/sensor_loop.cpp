// Runs the class behind the ros2_control plugin for tests: a command per line on standard input, for each a line of JSON.
//
//   new [PARAMETER=VALUE ...] [imu] [orientation] [compensated]   another loop; the one before is gone
//   open | wait MS | tare | log | max_age | stop
//   read                 one cycle
//   run SECONDS HZ       cycles at a steady pace: how many in which condition
//   sealed COUNT         the same at 1 kHz, in a thread to which the kernel allows nothing but sleeping
//   take CONDITION NOW_MS AGE_MS CHECKED FORCE [RECEIVED_MS CONNECTED]
//                        what controllers see of this, with the parameters of `new`
//   check JSON           what speaks against sensor 0 of this description
//   tool MODEL LAG_S FIR RATE_HZ COUNT
//                        the load of the tool of `new` in each of so many samples, a line each: seconds, acceleration, angular rate
//
// Built with ASan or TSan, whose hook counts what the cycles allocate.
#include "bota_ethercat_hardware/sensor_loop.hpp"

#include <linux/filter.h>
#include <linux/seccomp.h>
#include <sys/prctl.h>
#include <sys/syscall.h>

#include <cinttypes>
#include <cstdio>
#include <cstdlib>
#include <iostream>
#include <map>
#include <mutex>
#include <optional>
#include <sstream>

#include "json_text.hpp"

static thread_local std::size_t allocations = 0;

extern "C" int __sanitizer_install_malloc_and_free_hooks(void (*)(const volatile void*, std::size_t), void (*)(const volatile void*));

namespace {

using namespace bota_ethercat_hardware;

std::mutex lines_lock;
std::vector<std::string> lines;

void keep(Level level, const std::string& text) {
    constexpr const char* kLevels[] = {"info: ", "warning: ", "error: "};
    const std::lock_guard<std::mutex> guard(lines_lock);
    lines.push_back(kLevels[static_cast<int>(level)] + text);
}

std::string text_of(bool good, const Values& values, std::uint64_t sequence = 0) {
    Object told;
    told("allocated", allocations)("good", good)("sequence", sequence);
    for (std::size_t i = 0; i < values.size(); ++i) told(kSignals[i], values[i]);
    return told.text();
}

bool watched_read(SensorLoop& loop) {
    allocations = 0;
    return loop.read();
}

void sleep_until(std::int64_t due) {
    const timespec at{static_cast<time_t>(due / 1'000'000'000), static_cast<long>(due % 1'000'000'000)};
    clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &at, nullptr);
}

std::string run(SensorLoop& loop, double seconds, double hz) {
    std::map<int, long> conditions;
    std::size_t allocated = 0, bad = 0;
    std::int64_t due = bota_ethercat::monotonic_now_ns();
    for (long left = static_cast<long>(seconds * hz); left > 0; --left) {
        sleep_until(due += static_cast<std::int64_t>(1e9 / hz));
        bad += !watched_read(loop);
        allocated += allocations;
        ++conditions[loop.condition()];
    }
    Object counts;
    for (const auto& [condition, count] : conditions) counts(std::to_string(condition), count);
    return Object()("bad", bad)("allocated", allocated).raw("conditions", counts.text()).text();
}

/// From here on this thread is killed, and the process with it, for any other system call.
bool allow_sleeping_only() {
    std::vector<sock_filter> filter = {BPF_STMT(BPF_LD | BPF_W | BPF_ABS, offsetof(seccomp_data, nr))};
    // clock_gettime: a machine whose clock the vdso cannot read. The last ones are how a thread ends.
    for (const unsigned call : {SYS_clock_nanosleep, SYS_clock_gettime, SYS_exit, SYS_futex, SYS_munmap, SYS_madvise,
                                SYS_rt_sigprocmask, SYS_sigaltstack, SYS_mmap}) {
        filter.push_back(BPF_JUMP(BPF_JMP | BPF_JEQ | BPF_K, call, 0, 1));
        filter.push_back(BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_ALLOW));
    }
    filter.push_back(BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_KILL_PROCESS));
    const sock_fprog program{static_cast<unsigned short>(filter.size()), filter.data()};
    return prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) == 0 && prctl(PR_SET_SECCOMP, SECCOMP_MODE_FILTER, &program) == 0;
}

struct Sealed {
    SensorLoop& loop;
    long cycles, good;
    bool is_sealed;
};

void* cycles_of(void* given) {
    Sealed& sealed = *static_cast<Sealed*>(given);
    sealed.is_sealed = allow_sleeping_only();
    std::int64_t due = bota_ethercat::monotonic_now_ns();
    for (long i = 0; i < sealed.cycles; ++i) {
        sleep_until(due += 1'000'000);
        sealed.good += sealed.loop.read();
    }
    return nullptr;
}

std::string run_sealed(SensorLoop& loop, long count) {
    Sealed sealed{loop, count, 0, false};
    pthread_t thread{};  // not std::thread: to check its virtual calls UBSan makes system calls
    if (pthread_create(&thread, nullptr, cycles_of, &sealed) == 0) pthread_join(thread, nullptr);
    return Object()("sealed", sealed.is_sealed)("good", sealed.good).text();
}

}  // namespace

int main() {
    __sanitizer_install_malloc_and_free_hooks([](const volatile void*, std::size_t) { ++allocations; }, [](const volatile void*) {});
    std::optional<SensorLoop> maybe;
    Parameters parameters;
    std::optional<Gate> gate;
    for (std::string line, command; std::getline(std::cin, line);) {
        std::istringstream words(line);
        words >> command;
        std::string why, told = "{}";
        if (command == "new") {
            maybe.reset();
            lines.clear();
            parameters = Parameters();
            for (std::string word; words >> word;) {
                const std::size_t at = word.find('=');
                if (word == "imu") parameters.wants_imu = true;
                else if (word == "compensated") parameters.wants_compensated = true;
                else if (word == "orientation") parameters.wants_orientation = true;
                else if (why.empty()) why = set_parameter(parameters, word.substr(0, at), at == std::string::npos ? "" : word.substr(at + 1));
            }
            maybe.emplace(parameters, keep);
            gate.emplace(parameters);
            told = Object()("why", why).text();
        } else if (command == "check") {
            const std::string text = line.substr(6);
            bota_ethercat::Description description;
            const bool is_read = bota_ethercat::detail::read_description(bota_ethercat::json::Value(text), description);
            const SensorInfo* const found = description.find(0);
            if (!is_read || found == nullptr) return 2;
            told = Object()("why", objection(parameters, *found, *found))("max_age", max_age(parameters, *found)).text();
        } else if (command == "take") {
            double now = 0, age = 0, force = 0;
            int condition = 0, checked = 0;
            words >> condition >> now >> age >> checked >> force;
            Received received;
            bota_ethercat::Reading& reading = received.reading;
            received.is_checked = checked != 0;
            double at = now;
            int connected = 1;
            if (!(words >> at >> connected)) at = now, connected = 1;
            received.at_ns = std::llround(at * 1e6);
            received.is_connected = connected != 0;
            received.max_age_ns = std::llround(parameters.max_age.value_or(1e6) * 1e9);
            reading.condition = static_cast<bota_ethercat::Condition>(condition);
            reading.has_sample = age >= 0;
            if (age >= 0) reading.age_ns = std::llround(age * 1e6);
            reading.sample.force[0] = force;
            received.tool[0] = 0.25;
            allocations = 0;
            const bool good = gate->update(received, std::llround(now * 1e6));
            told = text_of(good, gate->values());
        } else if (command == "tool") {
            std::string model;
            double lag_s = 0, rate_hz = 0;
            int fir = 0, count = 0;
            words >> model >> lag_s >> fir >> rate_hz >> count;
            Tool tool(parameters.payload, model, Alignment(lag_s, 0.00096, fir != 0, rate_hz));
            std::vector<double> loads;
            for (; count > 0 && std::getline(std::cin, line); --count) {
                std::vector<double> numbers;
                for (std::istringstream text(line); text >> line;) numbers.push_back(std::strtod(line.c_str(), nullptr));
                bota_ethercat::Sample sample;
                std::copy_n(numbers.begin() + 1, 3, sample.acceleration.begin());
                std::copy_n(numbers.begin() + 4, 3, sample.angular_rate.begin());
                const Wrench load = tool.follow(sample, numbers[0]);
                loads.insert(loads.end(), load.begin(), load.end());
            }
            told = json_list(loads, [](double value) { return json_text(value); });
        } else if (command == "bounds") {
            std::array<double, 12> n{};
            std::string model;
            double lag_s = 0, rate_hz = 0;
            int fir = 0, tared = 0;
            words >> model >> lag_s >> fir >> rate_hz >> tared;
            for (double& each : n) words >> each;
            const Tool tool(parameters.payload, model, Alignment(lag_s, 0.00096, fir != 0, rate_hz));
            const Bounds bounds = tared == 2 ? tool.bounds(true, bota_ethercat::Vector3{n[9], n[10], n[11]}) : tool.bounds(tared != 0);
            const auto found = bounds.at({n[0], n[1], n[2]}, {n[3], n[4], n[5]}, {n[6], n[7], n[8]});
            told = json_list(std::vector<double>{found[0], found[1]}, [](double value) { return json_text(value); });
        } else if (command == "log") {
            const std::lock_guard<std::mutex> guard(lines_lock);
            told = json_list(lines, [](const std::string& each) { return json_text(each); });
        } else if (!maybe) {
            return 2;
        } else if (command == "open" || command == "tare" || command == "wait") {
            long ms = 0;
            words >> ms;
            bool ok = true;
            if (command == "open") ok = maybe->open(why);
            else ok = command == "tare" ? maybe->tare(why) : maybe->wait_until_usable(why, static_cast<double>(ms) / 1e3);
            told = Object()("ok", ok)("why", ok ? "" : why).text();
        } else if (command == "read") {
            const std::uint64_t sequence = maybe->reading().sequence;
            const bool good = watched_read(*maybe);
            told = text_of(good, maybe->values(), sequence);
        } else if (command == "max_age") {
            told = json_text(maybe->max_age());
        } else if (command == "run") {
            double seconds = 0, hz = 1000;
            words >> seconds >> hz;
            told = run(*maybe, seconds, hz);
        } else if (command == "sealed") {
            long count = 0;
            words >> count;
            told = run_sealed(*maybe, count);
        } else if (command == "stop") {
            maybe.reset();
        } else {
            return 2;
        }
        std::printf("%s\n", told.c_str());
        std::fflush(stdout);
    }
    return 0;
}
