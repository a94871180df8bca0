// Connections, made and checked outside the control thread, and handed to it.
//
// A connection that is lost, or whose sensor was reconfigured, is replaced: the connector's thread makes another client,
// checks that sensor and settings are those of `open`, and leaves it in a slot. The control thread takes it, and leaves the
// old one in another slot, for the connector to destroy. Neither waits for the other: each slot is an atomic pointer.
#pragma once

#include <pthread.h>
#include <sched.h>

#include <atomic>
#include <chrono>
#include <cmath>
#include <csignal>
#include <functional>
#include <memory>
#include <optional>
#include <string>
#include <string_view>
#include <thread>
#include <utility>

#include <bota_ethercat.hpp>

#include "bota_ethercat_hardware/gate.hpp"
#include "bota_ethercat_hardware/identity.hpp"
#include "bota_ethercat_hardware/parameters.hpp"

namespace bota_ethercat_hardware {

enum class Level : std::uint8_t { info, warning, error };
/// Takes a sentence for a person; called from the thread that configures and from the connector's, never from `read`.
using Log = std::function<void(Level, const std::string&)>;

class Connector {
public:
    using Client = bota_ethercat::Client;

    /// `parameters` must outlive it.
    Connector(const Parameters& parameters, Log log) : parameters_(parameters), log_(std::move(log)) {}
    Connector(const Connector&) = delete;
    Connector& operator=(const Connector&) = delete;
    ~Connector() { stop(); }

    // -- the configuring thread

    /// The first connection, which says which sensor it is; waits up to `connect_timeout` for a server. Null: `why`.
    std::unique_ptr<Client> open(std::string& why) {
        const auto end = bota_ethercat::monotonic_now_ns() + static_cast<std::int64_t>(parameters_.connect_timeout * 1e9);
        pinned_.reset();
        for (;;) {
            bool may_come = false;
            Identity found;
            if (auto client = attempt(found, why, may_come)) {
                pinned_ = found;
                return client;
            }
            if (!may_come || bota_ethercat::monotonic_now_ns() >= end) return nullptr;
            std::this_thread::sleep_for(std::chrono::milliseconds(100));
        }
    }

    /// The sensor of `open`.
    const Identity& identity() const { return *pinned_; }

    /// Begin to replace connections.
    void start() {
        stop();
        stopping_ = false;
        wanted_ = false;
        sigset_t all, before;
        sigfillset(&all);
        pthread_sigmask(SIG_SETMASK, &all, &before);  // signals are for the threads of the program
        thread_ = std::thread([this] { run(); });
        pthread_sigmask(SIG_SETMASK, &before, nullptr);
    }

    /// The thread ends by itself: at once, or, if it is connecting, within some seconds. Does not wait.
    void stop_soon() noexcept { stopping_ = true; }

    /// Wait for it, and destroy what lies in the slots.
    void stop() noexcept {
        stopping_ = true;
        if (thread_.joinable()) thread_.join();
        delete offered_.exchange(nullptr);
        delete returned_.exchange(nullptr);
    }

    // -- the control thread

    /// The client to read from now: `current`, or the one that replaces it.
    Client* replace(Client* current) noexcept {
        if (offered_.load(std::memory_order_acquire) == nullptr) return current;
        wanted_.store(false, std::memory_order_relaxed);  // before the slot is seen empty
        Client* const next = offered_.exchange(nullptr, std::memory_order_acq_rel);
        returned_.store(current, std::memory_order_release);  // empty: nothing is offered before it was emptied
        return next;
    }

    /// Ask for another connection, once for each.
    void ask(std::string_view reason) noexcept {
        if (wanted_.load(std::memory_order_relaxed)) return;
        reason_.clear();
        reason_.add(reason);
        wanted_.store(true, std::memory_order_release);
    }

    /// What the controllers see, for the log.
    void tell(int condition) noexcept { condition_.store(condition, std::memory_order_relaxed); }

private:
    static constexpr auto kPace = std::chrono::milliseconds(10);
    static constexpr std::int64_t kRetryNs = 100'000'000, kQuietNs = 1'000'000'000;
    static constexpr auto kPatience = std::chrono::seconds(1);  // for one attempt, and the request before it

    void run() noexcept {
        const sched_param ordinary{};
        pthread_setschedparam(pthread_self(), SCHED_OTHER, &ordinary);  // a real-time priority may have been inherited
        pthread_setname_np(pthread_self(), "bota_connector");
        std::int64_t retry_ns = 0;
        bool asked = false;
        std::string said;
        for (; !stopping_; std::this_thread::sleep_for(kPace)) {
            delete returned_.exchange(nullptr, std::memory_order_acq_rel);
            const std::int64_t now = bota_ethercat::monotonic_now_ns();
            watch(now);
            if (offered_.load(std::memory_order_acquire) || !wanted_.load(std::memory_order_acquire) || now < retry_ns) continue;
            if (!asked) log_(Level::warning, reason_.c_str());
            asked = true;
            retry_ns = now + kRetryNs;
            Identity found;
            std::string why;
            bool may_come = false;
            if (auto client = attempt(found, why, may_come)) {
                log_(Level::info, "connected again to " + detail::named(found));
                asked = false;
                said.clear();
                delete returned_.exchange(nullptr, std::memory_order_acq_rel);  // the slot must be empty when this is taken
                offered_.store(client.release(), std::memory_order_release);
            } else if (why != said) {
                log_(may_come ? Level::warning : Level::error, why);
                said = why;
            }
        }
    }

    /// One attempt. Null: `why`, and whether it may succeed later without anybody doing something about the sensor.
    std::unique_ptr<Client> attempt(Identity& found, std::string& why, bool& may_come) {
        if (!inspect(found, why, may_come)) return nullptr;
        bota_ethercat::Options options;
        options.host = parameters_.host;
        options.port = parameters_.port;
        options.sensors = {parameters_.sensor};
        options.imu_units = parameters_.imu_raw_units;
        options.judge_imu = parameters_.wants_imu || parameters_.wants_orientation;
        options.max_age = bota_ethercat::nanoseconds(std::llround(max_age(parameters_, found) * 1e9));
        options.reconnect = bota_ethercat::Reconnect::when_told;
        auto client = std::make_unique<Client>(options);
        may_come = true;
        if (!client->connect(kPatience)) return why = client->error(), nullptr;
        // What is changed from here on is told on this connection. What was changed before that:
        const double rate_hz = found.rate_hz;
        if (!inspect(found, why, may_come)) return nullptr;
        if (std::fabs(found.rate_hz - rate_hz) < 1e-3) return client;
        return why = "the sensor is being reconfigured", may_come = true, nullptr;
    }

    /// Whether this is the sensor that is wanted, and set so that its numbers mean what they should.
    bool inspect(Identity& found, std::string& why, bool& may_come) {
        bota_ethercat::Control control(parameters_.host, parameters_.port);
        may_come = true;
        if (!control.ask("{\"action\":\"describe\"}", kPatience)) return why = control.error(), false;
        may_come = false;
        const std::string server = parameters_.host + " port " + std::to_string(parameters_.port) + ": ";
        int protocol = 0;
        if (!control.reply()["protocol"].get(protocol) || protocol != bota_ethercat::kProtocolVersion)
            return why = server + "the server speaks another version of the protocol", false;
        const std::string sensor = server + "sensor " + std::to_string(parameters_.sensor) + " ";
        if (!find(control.reply(), parameters_.sensor, found)) return why = sensor + "is not on the bus", false;
        why = objection(parameters_, found);
        if (why.empty() && pinned_) why = difference(*pinned_, found);
        if (!why.empty()) why.insert(0, sensor);
        return why.empty();
    }

    /// Log what the controllers see, when it changes and has been quiet for a while.
    void watch(std::int64_t now) {
        const int condition = condition_.load(std::memory_order_relaxed);
        if (condition == logged_ || now < quiet_until_ns_) return;
        const Reaction doing = reaction(parameters_, condition);
        if (doing == Reaction::use && logged_ != 0)
            log_(Level::info, std::string("samples are usable again") + (condition == 0 ? "" : ", though saturated"));
        else if (doing != Reaction::use)
            log_(Level::warning, std::string(condition_text(condition)) + "; on such samples: " + std::string(to_string(doing)));
        logged_ = condition;
        quiet_until_ns_ = now + kQuietNs;
    }

    const Parameters& parameters_;
    Log log_;
    std::optional<Identity> pinned_;
    std::thread thread_;
    std::atomic<bool> stopping_{false};
    std::atomic<Client*> offered_{nullptr};   // connector to control thread
    std::atomic<Client*> returned_{nullptr};  // and back
    std::atomic<bool> wanted_{false};
    std::atomic<int> condition_{0};
    bota_ethercat::Text<320> reason_;  // the control thread's until it sets `wanted_`, then the connector's until it offers
    int logged_ = 0;
    std::int64_t quiet_until_ns_ = 0;
};

}  // namespace bota_ethercat_hardware
