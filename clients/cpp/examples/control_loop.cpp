// SPDX-License-Identifier: Apache-2.0
// A control loop at 1 kHz: a velocity that follows the force felt at the sensor, and zero when the force is not known.
//
//     control_loop [--server HOST:PORT] [--hz 1000]        (without --server: $BOTA_SERVER)
//
// What to copy: one `latest` a cycle, `fresh` asked before the sample is used, a command that goes to zero otherwise.
// The robot is left out: `send_to_robot` stands for it.
#include <bota_ethercat.hpp>

#include <time.h>

#include <cmath>
#include <csignal>
#include <cstdio>
#include <cstdlib>
#include <cstring>

namespace {

volatile std::sig_atomic_t ending = 0;

using bota_ethercat::Vector3;

/// m/s, along the sensor's axes.
void send_to_robot(const Vector3& /*velocity*/) {}

/// An admittance without mass: m/s per N beyond a dead band, limited.
Vector3 follow(const Vector3& force) {
    constexpr double kDeadBand = 2.0, kGain = 0.01, kLimit = 0.1;  // N, m/s per N, m/s
    Vector3 velocity{};
    for (std::size_t axis = 0; axis < 3; ++axis) {
        const double beyond = std::fabs(force[axis]) - kDeadBand;
        const double speed = beyond > 0.0 ? kGain * beyond : 0.0;
        velocity[axis] = std::copysign(speed < kLimit ? speed : kLimit, force[axis]);
    }
    return velocity;
}

void sleep_until(std::int64_t due_ns) {
    const timespec due{static_cast<time_t>(due_ns / 1'000'000'000), static_cast<long>(due_ns % 1'000'000'000)};
    clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &due, nullptr);
}

}  // namespace

int main(int argc, char** argv) {
    bota_ethercat::Options options;
    options.max_age = std::chrono::milliseconds(5);  // four samples at 800 Hz: older is not acted on
    const char* server = nullptr;
    double hz = 1000.0;
    for (int i = 1; i < argc; i += 2) {
        const char* const value = i + 1 < argc ? argv[i + 1] : "";
        if (std::strcmp(argv[i], "--server") == 0) server = value;
        else hz = std::strcmp(argv[i], "--hz") == 0 ? std::atof(value) : 0.0;
    }
    if (!(hz >= 1.0 && hz <= 10000.0) || !bota_ethercat::choose_server(server, options))
        return std::fprintf(stderr, "usage: control_loop [--server HOST:PORT, else $BOTA_SERVER] [--hz 1 to 10000]\n"), 2;
    std::signal(SIGINT, [](int) { ending = 1; });
    std::signal(SIGTERM, [](int) { ending = 1; });

    bota_ethercat::Client sensor(options);
    if (!sensor.connect()) return std::fprintf(stderr, "control_loop: %s\n", sensor.error()), 1;
    const bota_ethercat::Scheduling given = bota_ethercat::make_real_time(70, -1, true);
    if (!given.refused.empty()) std::fprintf(stderr, "control_loop: not granted: %s\n", given.refused.c_str());

    auto before = bota_ethercat::Condition::fresh;
    const auto period_ns = static_cast<std::int64_t>(1e9 / hz);
    for (std::int64_t due_ns = bota_ethercat::monotonic_now_ns(); !ending; due_ns += period_ns) {
        sleep_until(due_ns);
        const bota_ethercat::Reading reading = sensor.latest();
        send_to_robot(reading.fresh() ? follow(reading.sample.force) : Vector3{});
        if (reading.condition != before)  // in a real controller another thread prints
            std::fprintf(stderr, "control_loop: %s %s\n", to_string(reading.condition), sensor.error());
        before = reading.condition;
    }
    send_to_robot({});
    return 0;
}
