// The thread that receives: it reads what arrives and leaves the newest reading to the control thread, which so makes no
// system call (a recv() of TCP costs 10 us and more, because it sends the acknowledgement).
//
// After a new connection, and after the sensor was reconfigured, samples are unchecked until sensor and settings are found to
// be those of `open`.
#pragma once

#include <poll.h>
#include <pthread.h>

#include <atomic>
#include <chrono>
#include <cmath>
#include <csignal>
#include <functional>
#include <memory>
#include <optional>
#include <string>
#include <thread>
#include <utility>

#include <bota_ethercat.hpp>

#include "bota_ethercat_hardware/gate.hpp"
#include "bota_ethercat_hardware/identity.hpp"
#include "bota_ethercat_hardware/latest.hpp"
#include "bota_ethercat_hardware/parameters.hpp"

namespace bota_ethercat_hardware {

enum class Level : std::uint8_t { info, warning, error };
/// Takes a sentence for a person; called from the thread that configures and from the receiving one, never from `read`.
using Log = std::function<void(Level, const std::string&)>;

class Receiver {
public:
    /// `parameters` must outlive it.
    Receiver(const Parameters& parameters, Log log) : parameters_(parameters), log_(std::move(log)) {}
    Receiver(const Receiver&) = delete;
    Receiver& operator=(const Receiver&) = delete;
    ~Receiver() { stop(); }

    // -- the configuring thread

    /// The first connection, which says which sensor it is, and begin to receive. Waits up to `connect_timeout` for a server.
    bool open(std::string& why) {
        stop();
        const auto end = bota_ethercat::monotonic_now_ns() + static_cast<std::int64_t>(parameters_.connect_timeout * 1e9);
        pinned_.reset();
        bota_ethercat::Options options;
        options.host = parameters_.host;
        options.port = parameters_.port;
        options.sensors = {parameters_.sensor};
        options.imu_units = parameters_.imu_raw_units;
        options.judge_imu = parameters_.wants_imu || parameters_.wants_orientation;
        options.reconnect = bota_ethercat::Reconnect::when_told;
        client_ = std::make_unique<bota_ethercat::Client>(options);
        bool may_come = false;
        while (!connect(why, may_come)) {
            if (!may_come || bota_ethercat::monotonic_now_ns() >= end) return false;
            std::this_thread::sleep_for(std::chrono::milliseconds(100));
        }
        latest_.next() = Received{{}, true, true, bota_ethercat::monotonic_now_ns(), max_age_ns_};
        latest_.publish();
        start();
        return true;
    }

    /// The sensor of `open`.
    const Identity& identity() const { return *pinned_; }

    /// The thread ends by itself: at once, or, if it is connecting, within some seconds. Does not wait.
    void stop_soon() noexcept { stopping_ = true; }

    /// Wait for it.
    void stop() noexcept {
        stopping_ = true;
        if (thread_.joinable()) thread_.join();
        client_.reset();
    }

    // -- the control thread

    /// What was received last. Waits for nobody.
    const Received& latest() noexcept { return latest_.take(); }

    /// What the controllers see, for the log.
    void tell(int condition) noexcept { condition_.store(condition, std::memory_order_relaxed); }

private:
    static constexpr int kPaceMs = 5;  // without anything from the server: how soon it is seen that nothing comes
    static constexpr std::int64_t kRetryNs = 100'000'000, kQuietNs = 1'000'000'000;
    static constexpr auto kPatience = std::chrono::seconds(1);  // for one attempt, and the request before it

    void start() {
        stopping_ = false;
        sigset_t all, before;
        sigfillset(&all);
        pthread_sigmask(SIG_SETMASK, &all, &before);  // signals are for the threads of the program
        thread_ = std::thread([this] { run(); });
        pthread_sigmask(SIG_SETMASK, &before, nullptr);
    }

    void run() noexcept {
        pthread_setname_np(pthread_self(), "bota_receiver");
        set_priority();
        std::int64_t retry_ns = 0;
        bool is_asked = false;  // for another connection
        std::string said;
        while (!stopping_) {
            const bool is_good = receive();
            const std::int64_t now = bota_ethercat::monotonic_now_ns();
            watch(now);
            if (is_good || now < retry_ns) continue;
            if (!is_asked) log_(Level::warning, client_->connected() ? "the sensor's settings were changed" : client_->error());
            is_asked = true;
            retry_ns = now + kRetryNs;
            std::string why;
            bool may_come = false;
            if (connect(why, may_come)) {
                log_(Level::info, "connected again to " + detail::named(*pinned_));
                is_asked = false;
                said.clear();
            } else if (why != said) {
                log_(may_come ? Level::warning : Level::error, why);
                said = why;
            }
        }
    }

    /// Wait for something, read all of it and hand it over. False: it needs to be connected, or checked.
    bool receive() noexcept {
        pollfd one{client_->fd(), POLLIN, 0};
        (void)::poll(&one, one.fd < 0 ? 0 : 1, kPaceMs);
        Received& received = latest_.next();
        received.reading = client_->latest(parameters_.sensor);
        const bool is_checked = is_checked_ && client_->reconfigurations() == checked_at_;
        received.is_checked = is_checked && received.reading.received_ns >= checked_ns_;
        received.max_age_ns = max_age_ns_;
        received.at_ns = bota_ethercat::monotonic_now_ns();
        received.is_connected = client_->connected();
        const bool is_good = is_checked && received.is_connected;
        latest_.publish();
        return is_good;
    }

    /// As `receive_priority` has it.
    void set_priority() noexcept {
        const auto given = bota_ethercat::make_real_time(parameters_.receive_priority);
        if (!given.refused.empty())
            log_(Level::warning, "the receiving thread was not granted " + given.refused +
                                     ": samples come late on a busy machine; allow it, or set receive_priority to 0");
    }

    /// Connect, if it is not connected, and check the sensor. False: `why`, and whether it may succeed later without anybody
    /// doing something about the sensor.
    bool connect(std::string& why, bool& may_come) {
        Identity found;
        const bool is_new = !client_->connected();
        if (is_new) {
            is_checked_ = false;
            if (!inspect(found, why, may_come)) return false;
            if (!client_->connect(kPatience)) return why = client_->error(), may_come = true, false;
        }
        const auto reconfigurations = client_->reconfigurations();  // those to come are told on this connection
        if (!inspect(found, why, may_come)) {
            if (is_new) client_->close();
            return false;
        }
        may_come = true;
        if (!pinned_) pinned_ = found;
        (void)client_->update();  // what came meanwhile is of the settings before
        if (client_->reconfigurations() != reconfigurations) return why = "the sensor is being reconfigured", false;
        max_age_ns_ = std::llround(max_age(parameters_, found) * 1e9);
        client_->set_max_age(bota_ethercat::nanoseconds(max_age_ns_));
        checked_at_ = reconfigurations;
        checked_ns_ = bota_ethercat::monotonic_now_ns();
        is_checked_ = true;
        return true;
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
    std::int64_t max_age_ns_ = 0;     // of the client's samples
    std::unique_ptr<bota_ethercat::Client> client_;  // the receiving thread's while there is one
    bool is_checked_ = false;         // the sensor, on this connection
    std::uint32_t checked_at_ = 0;    // number of reconfigurations
    std::int64_t checked_ns_ = 0;     // samples received before are not used
    Latest latest_;
    std::atomic<bool> stopping_{false};
    std::atomic<int> condition_{0};
    int logged_ = 0;
    std::int64_t quiet_until_ns_ = 0;
};

}  // namespace bota_ethercat_hardware
