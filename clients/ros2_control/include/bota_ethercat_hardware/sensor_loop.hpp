// SPDX-License-Identifier: Apache-2.0
// A sensor in a control loop, without ROS: connect and check it, then `read` it once a cycle. Controllers see a `Gate`.
//
//     SensorLoop loop(parameters, log);
//     if (!loop.open(why) || !loop.wait_until_usable(why)) return fail(why);
//     while (running) if (!loop.read()) stop_controllers();      // loop.values() has the state interfaces
//
// `read` allocates nothing, takes no locks, never blocks or logs, and makes no system call: a thread of its own receives (a
// recv() of TCP costs 10 us and more, because it sends the acknowledgement). One thread at a time calls the other methods.
//
// The client makes a lost connection anew. After that, and after the sensor was reconfigured, samples are unchecked until
// sensor and settings are found to be those of `open`.
#pragma once

#include <poll.h>
#include <pthread.h>

#include <algorithm>
#include <array>
#include <atomic>
#include <charconv>
#include <chrono>
#include <cmath>
#include <csignal>
#include <functional>
#include <optional>
#include <string>
#include <thread>
#include <utility>

#include <bota_ethercat.hpp>

#include "bota_ethercat_hardware/parameters.hpp"

namespace bota_ethercat_hardware {

using bota_ethercat::Condition;
using bota_ethercat::monotonic_now_ns;
using bota_ethercat::SensorInfo;

// -- what controllers see: no allocation, no locks, no system calls

/// In this order they are in `Values`. Force N, torque Nm, acceleration m/s^2 (+g along the axis that points up),
/// angular velocity rad/s, orientation x y z w, temperature degrees Celsius, force and torque without the tool's and without bias,
/// age s, condition a `bota_ethercat::Condition`.
inline constexpr std::array<std::string_view, 25> kSignals = {
    "force.x", "force.y", "force.z", "torque.x", "torque.y", "torque.z",
    "linear_acceleration.x", "linear_acceleration.y", "linear_acceleration.z",
    "angular_velocity.x", "angular_velocity.y", "angular_velocity.z",
    "orientation.x", "orientation.y", "orientation.z", "orientation.w", "temperature",
    "compensated.force.x", "compensated.force.y", "compensated.force.z",
    "compensated.torque.x", "compensated.torque.y", "compensated.torque.z", "age", "condition",
};
inline constexpr std::size_t kImu = 6, kOrientation = 12, kTemperature = 16, kCompensated = 17, kMeasured = 23,
                             kAge = 23, kCondition = 24;
using Values = std::array<double, kSignals.size()>;

inline constexpr double kNaN = NAN, kInfinity = INFINITY;
inline double seconds(std::int64_t ns) noexcept { return static_cast<double>(ns) / 1e9; }

/// The index of a state interface in `Values`; their number if there is none of that name.
inline std::size_t signal(std::string_view name) noexcept {
    return static_cast<std::size_t>(std::find(kSignals.begin(), kSignals.end(), name) - kSignals.begin());
}

/// What the receiving thread found.
struct Received {
    bota_ethercat::Reading reading;
    Wrench tool{};  ///< load of the tool in the sample
    Wrench bias_change{};  ///< by how much the sensor's own offset has changed the bias
    bool is_checked = true;  ///< false: sensor or settings may be others than when they were accepted
    bool is_connected = true;
    std::int64_t at_ns = 0;  ///< CLOCK_MONOTONIC of the reading
    std::int64_t max_age_ns = 0;
};

/// The newest of them, from the receiving thread to the control thread: neither waits for the other.
///
/// Three places: one is written, one is read, and the third holds the newest that was written; an atomic exchange swaps it.
class Latest {
public:
    /// For the writing thread: where to write the next one.
    Received& next() noexcept { return places_[written_]; }
    /// It is written.
    void publish() noexcept { written_ = newest_.exchange(written_ | kUnread, std::memory_order_acq_rel) & ~kUnread; }

    /// For the reading thread: the newest that was published; valid until the next call.
    const Received& newest() noexcept {
        if ((newest_.load(std::memory_order_relaxed) & kUnread) != 0)
            read_ = newest_.exchange(read_, std::memory_order_acq_rel) & ~kUnread;
        return places_[read_];
    }

private:
    static constexpr std::uint8_t kUnread = 4;

    std::array<Received, 3> places_{};
    std::atomic<std::uint8_t> newest_{0};
    std::uint8_t written_ = 1, read_ = 2;
};

/// The `condition` while settings or sensor are others than when the samples were last accepted; beside bota_ethercat's.
inline constexpr int kUnchecked = 100;

inline const char* condition_text(int condition) noexcept {
    if (condition == kUnchecked) return "unchecked: the sensor or its settings are not those that were accepted";
    return to_string(static_cast<Condition>(condition));
}

/// The policy as the URDF has it: what to do in a condition.
inline Reaction reaction(const Parameters& parameters, int condition) noexcept {
    if (condition == kUnchecked) return parameters.on_invalid;
    switch (static_cast<Condition>(condition)) {
        case Condition::fresh: return Reaction::use;
        case Condition::saturated: return parameters.on_saturated;
        case Condition::not_finite: case Condition::bad_clock: case Condition::invalid: return parameters.on_invalid;
        default: return parameters.on_stale;
    }
}

/// Turns what was received last into the values of the state interfaces and a verdict.
class Gate {
public:
    explicit Gate(const Parameters& parameters) noexcept : parameters_(parameters), bias_(parameters.bias) {
        values_.fill(kNaN);
        values_[kAge] = kInfinity;
    }

    /// True: the values may be used, or are what the policy has for a moment. False: it is an error.
    bool update(const Received& received, std::int64_t now_ns) noexcept {
        const bota_ethercat::Reading& reading = received.reading;
        if (reading.has_sample) sampled_ns_ = reading.age_ns == kNever ? kNever : received.at_ns - reading.age_ns;
        condition_ = static_cast<int>(reading.condition);
        if (reading.condition <= Condition::not_finite && now_ns - sampled_ns_ > received.max_age_ns)  // it has grown old since
            condition_ = static_cast<int>(received.is_connected ? Condition::late : Condition::disconnected);
        else if (!received.is_checked && reading.condition <= Condition::saturated)
            condition_ = kUnchecked;
        else if (parameters_.wants_compensated && reading.condition <= Condition::saturated && bota_ethercat::is_nan(received.tool[0]))
            condition_ = static_cast<int>(Condition::not_finite);
        values_[kAge] = sampled_ns_ == kNever ? kInfinity : seconds(now_ns - sampled_ns_);
        values_[kCondition] = condition_;
        const Reaction doing = reaction(parameters_, condition_);
        if (doing == Reaction::use) {
            fill(reading.sample, received.tool, received.bias_change);
            trouble_ns_ = kNever;
            return true;
        }
        if (trouble_ns_ == kNever) trouble_ns_ = now_ns;
        const bool bearable = doing != Reaction::error && seconds(now_ns - trouble_ns_) < parameters_.error_after;
        if (doing != Reaction::hold || !bearable) std::fill_n(values_.begin(), kMeasured, kNaN);
        return bearable;
    }

    const Values& values() const noexcept { return values_; }
    int condition() const noexcept { return condition_; }
    /// Whether the values are those of a sample that the policy lets through.
    bool usable() const noexcept { return reaction(parameters_, condition_) == Reaction::use; }
    /// `error_after` counts from the next reading.
    void restart() noexcept { trouble_ns_ = kNever; }
    /// The sensor was tared: no bias is left.
    void clear_bias() noexcept { bias_ = {}; }

private:
    static constexpr std::int64_t kNever = INT64_MAX;

    /// All that is measured.
    void fill(const bota_ethercat::Sample& sample, const Wrench& tool, const Wrench& change) noexcept {
        const auto twelve = sample.array();
        std::copy(twelve.begin(), twelve.end(), values_.begin());
        for (std::size_t i = 0; i < sample.orientation.size(); ++i)
            values_[kOrientation + i] = sample.has_orientation ? sample.orientation[i] : kNaN;
        values_[kTemperature] = sample.temperature;
        for (std::size_t i = 0; i < tool.size(); ++i) values_[kCompensated + i] = twelve[i] - (bias_[i] + change[i]) - tool[i];
    }

    const Parameters& parameters_;
    Values values_{};
    Wrench bias_;
    int condition_ = static_cast<int>(Condition::silent);
    std::int64_t sampled_ns_ = kNever;  // the instant of the newest sample, CLOCK_MONOTONIC; it outlives a connection
    std::int64_t trouble_ns_ = kNever;  // since when nothing was usable
};

// -- which sensors are used

namespace detail {

inline std::string text(double number) {
    std::array<char, 32> digits{};
    const auto done = std::to_chars(digits.data(), digits.data() + digits.size(), number, std::chars_format::general, 4);
    return {digits.data(), done.ptr};
}

inline std::string named(const SensorInfo& sensor) {
    return sensor.name.c_str() + (", serial " + std::to_string(sensor.serial));
}

}  // namespace detail

/// s up to which a sample of this sensor is fresh.
inline double max_age(const Parameters& parameters, const SensorInfo& sensor) {
    return parameters.max_age.value_or(std::max(0.01, sensor.rate_hz > 0.0 ? 4.0 / sensor.rate_hz : 0.0));
}

/// Why this sensor, set like this, cannot give what the URDF asks for, or is another one, or its numbers mean something else,
/// than `before`, when configured; empty if all is well.
inline std::string objection(const Parameters& parameters, const SensorInfo& sensor, const SensorInfo& before) {
    using detail::named;
    using detail::text;
    if (parameters.serial && *parameters.serial != sensor.serial)
        return "is " + named(sensor) + ", but the parameter serial is " + std::to_string(*parameters.serial);
    if (before.serial != sensor.serial) return "is " + named(sensor) + ", and was " + named(before) + ", when configured";
    if (sensor.calibration_matrix == false)
        return "sends ADC counts instead of N and Nm: switch its setting calibration_matrix on";
    if (sensor.rate_hz > 0.0 && max_age(parameters, sensor) * sensor.rate_hz < 2.0)
        return "has a sample every " + text(1.0 / sensor.rate_hz) + " s: raise max_age (" + text(*parameters.max_age) +
               " s) to at least " + text(2.0 / sensor.rate_hz);
    if (parameters.wants_imu && sensor.imu_active == 0)
        return "has its IMU switched off: set imu_active to 1, or leave linear_acceleration, angular_velocity and payload out of the URDF";
    if (parameters.has_payload && sensor.inertia_compensation == true)
        return "subtracts gravity and inertia itself: switch its setting inertia_compensation off, or leave the payload out";
    if (parameters.has_payload && sensor.coordinate_system == true)
        return "gives force and torque in a frame configured in it, and how that is turned to its IMU is not known: switch its "
               "setting coordinate_system off, or leave the payload out";
    for (const auto& [name, setting] : {std::pair("coordinate_system", &SensorInfo::coordinate_system),
                                        std::pair("inertia_compensation", &SensorInfo::inertia_compensation)})
        if (before.*setting && sensor.*setting && before.*setting != sensor.*setting)
            return std::string("has another ") + name + " than when configured: change it back, or configure anew";
    return {};
}

// -- the loop

enum class Level : std::uint8_t { info, warning, error };
/// Takes a sentence for a person; called from the thread that configures and from the receiving one, never from `read`.
using Log = std::function<void(Level, const std::string&)>;

class SensorLoop {
public:
    SensorLoop(Parameters parameters, Log log)
        : parameters_(std::move(parameters)), log_(std::move(log)), client_(options(parameters_)), gate_(parameters_) {}
    ~SensorLoop() {
        stop_soon();
        if (thread_.joinable()) thread_.join();
    }

    /// Connect, check the sensor, begin to receive. Waits up to `connect_timeout` for a server.
    bool open(std::string& why) {
        const std::int64_t begin = monotonic_now_ns();
        while (!client_.connect(std::chrono::seconds(1))) {
            if (client_.refused() || seconds_since(begin) >= parameters_.connect_timeout) return fail(why, client_.error());
            std::this_thread::sleep_for(std::chrono::milliseconds(100));
        }
        receive();
        if (!objection_.empty()) {
            client_.close();
            return fail(why, objection_);
        }
        if (tool_) bounds_ = tool_->bounds(parameters_.on_activate_tare);
        sigset_t all, before;
        sigfillset(&all);
        pthread_sigmask(SIG_SETMASK, &all, &before);  // signals are for the threads of the program
        thread_ = std::thread([this] { run(); });
        pthread_sigmask(SIG_SETMASK, &before, nullptr);
        return true;
    }

    /// The sensor of `open`.
    const SensorInfo& sensor() const { return *sensor_; }
    /// Of the compensated wrench with the sensor of `open`, if there is a tool.
    const std::optional<Bounds>& bounds() const { return bounds_; }
    /// s up to which a sample is fresh now: another rate may make it another.
    double max_age() noexcept { return seconds(latest_.newest().max_age_ns); }
    /// The newest reading, which the next `read` shows, or a newer one.
    const bota_ethercat::Reading& reading() noexcept { return latest_.newest().reading; }

    /// Set the sensor's offset so that it reads the load of the tool now, or zero where that is not known. Waits for samples.
    bool tare(std::string& why) {
        Wrench load{};
        if (parameters_.has_payload && !mean_load(load, why)) return false;
        bota_ethercat::Control control(parameters_.client.host, parameters_.client.port);
        bota_ethercat::TareResult result;
        if (!control.tare(result, parameters_.sensor(), 400, load))
            return fail(why, std::string("the sensor could not be tared: ") + control.error());
        tared_offset_ = result.new_offset;
        is_tared_.store(true, std::memory_order_release);
        while (is_tared_ && !stopping_) std::this_thread::sleep_for(std::chrono::milliseconds(1));  // the other thread knows
        gate_.clear_bias();
        log_(Level::info, parameters_.has_payload
                              ? "tared to the load of the tool in this pose: right in every pose"
                              : "tared to zero in this pose, the weight of a tool included: it shows in others; give tool_mass");
        return true;
    }

    /// Wait for a sample that was taken from now on and that controllers may use.
    bool wait_until_usable(std::string& why, double timeout_s = 2.0) {
        for (const std::int64_t begin = monotonic_now_ns(); seconds_since(begin) < timeout_s;) {
            (void)read();
            if (gate_.usable() && values()[kAge] <= seconds_since(begin)) {
                gate_.restart();
                return true;
            }
            std::this_thread::sleep_for(std::chrono::milliseconds(1));
        }
        return fail(why, "no usable sample within " + detail::text(timeout_s) + " s; " + condition_text(gate_.condition()));
    }

    /// Once a cycle. False: it is an error by the parameters.
    bool read() noexcept {
        const bool good = gate_.update(latest_.newest(), monotonic_now_ns());
        condition_.store(gate_.condition(), std::memory_order_relaxed);
        return good;
    }

    const Values& values() const noexcept { return gate_.values(); }
    int condition() const noexcept { return gate_.condition(); }
    /// The receiving thread ends soon; does not wait.
    void stop_soon() noexcept { stopping_ = true; }

private:
    static constexpr int kPaceMs = 5;  // without anything from the server: how soon it is seen that nothing comes
    static constexpr std::int64_t kQuietNs = 1'000'000'000;
    static constexpr int kMaxSamples = 1000;  // until they are handed over
    static constexpr double kDoubtAfter = 2.0;  // sample periods, as protocol/bota_ethercat/stream/timeline.py
    static constexpr int kLoads = 100;         // samples of the load before a tare

    /// The load of the tool, N and Nm: the mean of some samples.
    bool mean_load(Wrench& mean, std::string& why) {
        for (int count = 1; count <= kLoads; ++count) {
            if (!wait_until_usable(why)) return false;
            const Wrench& load = latest_.newest().tool;
            for (std::size_t i = 0; i < mean.size(); ++i) mean[i] += (load[i] - mean[i]) / count;
        }
        return true;
    }

    static bool fail(std::string& why, std::string text) {
        why = std::move(text);
        return false;
    }

    static double seconds_since(std::int64_t begin_ns) noexcept { return seconds(monotonic_now_ns() - begin_ns); }

    static bota_ethercat::Options options(const Parameters& parameters) {
        bota_ethercat::Options options = parameters.client;
        options.judge_imu = parameters.wants_imu || parameters.wants_orientation;
        return options;
    }

    // -- the receiving thread

    void run() noexcept {
        pthread_setname_np(pthread_self(), "bota_receiver");
        const auto given = bota_ethercat::make_real_time(parameters_.receive_priority);
        if (!given.refused.empty())
            log_(Level::warning, "the receiving thread was not granted " + given.refused +
                                     ": samples come late on a busy machine; allow it, or set receive_priority to 0");
        while (!stopping_) {
            pollfd one{client_.fd(), POLLIN, 0};
            (void)::poll(&one, one.fd < 0 ? 0 : 1, kPaceMs);
            receive();
            log_changes();
        }
    }

    /// Read all that has arrived, or take a step towards a connection, and hand it over.
    void receive() noexcept {
        Received& received = latest_.next();
        if (is_tared_.load(std::memory_order_acquire)) {
            own_offset_.begin(sensor_->offset ? std::optional(tared_offset_) : std::nullopt);  // some servers never tell it
            is_tared_ = false;
        }
        for (int left = kMaxSamples; left > 0; --left) {  // the load of the tool needs every sample
            received.reading = client_.next({});
            if (!received.reading.is_new) break;
            if (tool_) load_ = tool_->follow(received.reading.sample, seconds(static_cast<std::int64_t>(received.reading.monotonic_ns)));
            if (const SensorInfo* const found = client_.description().find(parameters_.sensor()))
                follow(*found, received.reading.monotonic_ns);
        }
        received.tool = load_;
        received.bias_change = bias_change_;
        received.at_ns = monotonic_now_ns();
        received.is_connected = client_.connected();
        const std::pair news(client_.connections(), client_.reconfigurations());
        if (news != checked_) {
            check(news.first != checked_.first);
            checked_ = news;
            checked_ns_ = monotonic_now_ns();  // what came before may be of the settings before
        }
        received.is_checked = objection_.empty() && received.reading.received_ns >= checked_ns_;
        received.max_age_ns = max_age_ns_;
        latest_.publish();
    }

    /// The bias of the newest sample; the samples after a change of the sensor's offset may not have all of it yet.
    void follow(const SensorInfo& sensor, std::uint64_t monotonic_ns) noexcept {
        if (own_offset_.follow(sensor.offset) && sensor.rate_hz > 0.0)
            doubted_until_ns_ = newest_ns_ + static_cast<std::uint64_t>(std::llround(kDoubtAfter * 1e9 / sensor.rate_hz));
        bias_change_ = own_offset_.change();
        newest_ns_ = monotonic_ns;
        if (own_offset_.is_doubtful() || (doubted_until_ns_ > 0 && newest_ns_ <= doubted_until_ns_)) load_.fill(NAN);
        else if (!tool_) load_ = {};
    }

    /// Whether this is the sensor that is wanted, and set so that its numbers mean what they should: `objection_`.
    void check(bool is_new_connection) {
        const SensorInfo* const found = client_.description().find(parameters_.sensor());
        objection_ = found == nullptr ? "is not on the bus" : objection(parameters_, *found, sensor_.value_or(*found));
        if (!objection_.empty()) {
            objection_.insert(0, parameters_.client.host + " port " + std::to_string(parameters_.client.port) + ": sensor " +
                                     std::to_string(parameters_.sensor()) + " ");
            if (sensor_) log_(Level::error, objection_);
            return;
        }
        if (!sensor_) {
            sensor_ = *found;
            if (parameters_.sensor_offset || parameters_.bias != Wrench{}) begin_bias();
        } else log_(Level::info, is_new_connection ? "connected again to " + detail::named(*found)
                                                 : "the sensor's settings were changed, and are accepted");
        max_age_ns_ = std::llround(bota_ethercat_hardware::max_age(parameters_, *found) * 1e9);
        client_.set_max_age(std::chrono::nanoseconds(max_age_ns_));
        if (!parameters_.has_payload) return;
        const auto& [force_ns, acceleration_ns, rate_ns] = found->delay_ns;
        std::optional<double> lag_s;
        if (force_ns && acceleration_ns) lag_s = seconds(*force_ns - *acceleration_ns);
        const double gyroscope_s = seconds(rate_ns.value_or(0) - acceleration_ns.value_or(0));
        const double rate_hz = found->rate_hz > 0.0 ? found->rate_hz : 1600.0;
        tool_.emplace(parameters_.payload, found->name.view(), Alignment(lag_s, gyroscope_s, found->fir.value_or(false), rate_hz));
    }

    /// The bias of the parameters goes with an offset of the sensor.
    void begin_bias() {
        own_offset_.begin(parameters_.sensor_offset ? parameters_.sensor_offset : sensor_->offset);
        if (!parameters_.sensor_offset)
            log_(Level::warning, "it is not known with which offset of the sensor the bias was measured, and taken for that of now: "
                                 "give sensor_offset, or use the file of an identification");
        else if (!sensor_->offset)
            log_(Level::warning, "the server does not tell the sensor's own offset, so nothing is compensated: leave sensor_offset out, or tare");
    }

    /// Log why there is no connection, and what the controllers see, when it changes and has been quiet for a while.
    void log_changes() {
        std::string trouble = client_.connected() ? "" : client_.error();
        if (trouble != trouble_ && !trouble.empty()) log_(Level::warning, trouble);
        trouble_ = std::move(trouble);
        const std::int64_t now = monotonic_now_ns();
        const int condition = condition_.load(std::memory_order_relaxed);
        if (condition == logged_ || now < quiet_until_ns_) return;
        const Reaction doing = reaction(parameters_, condition);
        if (doing == Reaction::use && logged_ != 0)
            log_(Level::info, std::string("samples are usable again") + (condition == 0 ? "" : ", though saturated"));
        else if (doing != Reaction::use)
            log_(Level::warning, std::string(condition_text(condition)) + "; on such samples: " + name(doing));
        logged_ = condition;
        quiet_until_ns_ = now + kQuietNs;
    }

    const Parameters parameters_;
    Log log_;
    // The receiving thread's, once it runs:
    bota_ethercat::Client client_;
    std::optional<SensorInfo> sensor_;  // of `open`, unchanged since
    std::optional<Tool> tool_;
    OwnOffset own_offset_;
    Wrench load_{}, bias_change_{};     // of the tool, and of the bias, in the newest sample
    std::string objection_, trouble_;   // why the sensor is not used; why there is no connection
    std::pair<std::uint32_t, std::uint32_t> checked_{};  // connections and reconfigurations
    std::uint64_t newest_ns_ = 0, doubted_until_ns_ = 0;  // by the samples' CLOCK_MONOTONIC
    std::int64_t checked_ns_ = 0, max_age_ns_ = 0, quiet_until_ns_ = 0;
    int logged_ = 0;  // the condition
    // Of both:
    Latest latest_;
    std::atomic<int> condition_{0};
    std::atomic<bool> stopping_{false}, is_tared_{false};
    Wrench tared_offset_{};  // while `is_tared_`: the receiving thread is to go by it
    Gate gate_;  // the control thread's
    std::optional<Bounds> bounds_;  // since `open`, for any thread
    std::thread thread_;
};

}  // namespace bota_ethercat_hardware
