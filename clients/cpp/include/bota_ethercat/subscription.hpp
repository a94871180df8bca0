// What a `Client` does: connects, receives, sorts what arrives by sensor, and gives readings.
#ifndef BOTA_ETHERCAT_SUBSCRIPTION_HPP
#define BOTA_ETHERCAT_SUBSCRIPTION_HPP

#include <sys/types.h>

#include <chrono>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <memory>
#include <new>
#include <string>
#include <string_view>
#include <utility>

#include "bota_ethercat/connection.hpp"
#include "bota_ethercat/description.hpp"
#include "bota_ethercat/framing.hpp"
#include "bota_ethercat/json.hpp"
#include "bota_ethercat/machine.hpp"
#include "bota_ethercat/reading.hpp"
#include "bota_ethercat/sensor_state.hpp"
#include "bota_ethercat/text.hpp"

namespace bota_ethercat::detail {

/// `Client` without its constructors, so that its move operations are the ordinary ones.
class Subscription {
public:
    using Link = bota_ethercat::Link;

    /// Connect and subscribe; waits. False if it did not succeed within `timeout` or was refused: `error` says why,
    /// and `latest` and `next`, or `reconnect`, may go on trying.
    bool connect(nanoseconds timeout = std::chrono::seconds(2)) noexcept {
        const std::int64_t deadline = after(monotonic_now_ns(), timeout);
        refused_ = false;
        if (!connection_.usable() || !sensors_) return connection_.set_error().add("not enough memory"), false;
        if (!connection_.resolve()) return false;
        for (std::size_t tries = 0;;) {
            now_ns_ = monotonic_now_ns();
            if (link() == Link::down && (refused_ || tries++ == connection_.addresses())) break;
            if (now_ns_ >= deadline) {
                connection_.lose("the server did not answer in time");
                break;
            }
            if (link() == Link::down) connection_.begin(now_ns_);
            advance();
            if (connected()) return true;
            const std::int64_t ends = connection_.attempt_ends_ns();
            if (link() != Link::down) (void)connection_.wait(deadline < ends ? deadline : ends);
        }
        return false;
    }

    /// A step of making a lost connection anew, without waiting, one attempt per `reconnect_every`; true once connected.
    /// With `Reconnect::when_told` only this and `connect` do so: call it every few milliseconds.
    bool reconnect() noexcept {
        now_ns_ = monotonic_now_ns();
        advance();
        return connected();
    }

    /// End the connection; nothing is tried again until `connect`.
    void close() noexcept { connection_.close(); }

    /// Read what has arrived, without waiting. Returns how many DATA messages that were.
    std::size_t update() noexcept {
        now_ns_ = monotonic_now_ns();
        more_waits_ = false;
        if (!may_read()) return 0;
        std::size_t frames = 0, budget = options_.max_bytes_per_call;
        bool may_be_more = true;
        for (int reads = 0;; ++reads) {
            frames += take_messages();
            if (link() == Link::down || !may_be_more) break;
            if (budget == 0 || reads == kMostReads) {
                more_waits_ = true;
                break;
            }
            const ssize_t count = receive(budget);
            if (count <= 0) break;
            // A few messages are all there was. After a stall, reading makes room and more comes at once.
            may_be_more = count >= kBacklog || budget == 0;
        }
        return frames;
    }

    /// The newest sample of the sensor at position `place`, after reading everything that has arrived.
    Reading latest(std::uint8_t place = 0) noexcept {
        update();
        return read(place);
    }

    /// The same without reading the socket: for the second sensor of a chain, after `latest` of the first.
    Reading peek(std::uint8_t place = 0) noexcept {
        now_ns_ = monotonic_now_ns();
        return read(place);
    }

    /// The next sample of any sensor, in order, none left out; waits at most `timeout`.
    ///
    /// Without one the reading is what `latest` of the first wanted sensor would be: `is_new` is false, `condition`
    /// says why. Returns early when the connection is lost and when a signal handler ran; at once if there is no
    /// connection and nothing else may make one (`Reconnect::when_told`).
    Reading next(nanoseconds timeout) noexcept {
        now_ns_ = monotonic_now_ns();
        more_waits_ = false;
        const std::int64_t deadline = after(now_ns_, timeout);
        for (bool has_read = false; may_read() || options_.reconnect == Reconnect::by_itself;) {
            const Link before = link();
            Frame frame;
            while (before >= Link::subscribing && take_message(frame)) {
                if (frame.process_data && (frame.flags & (kRepeated | kInvalid)) == 0) return read(frame.sensor);
            }
            // A server that sends without end what is no sample does not hold this up.
            if (has_read && now_ns_ >= deadline) break;
            if (link() >= Link::subscribing) {
                std::size_t budget = options_.max_bytes_per_call;
                has_read = true;
                if (receive(budget) > 0) continue;
            } else {
                now_ns_ = monotonic_now_ns();
            }
            if (now_ns_ >= deadline || (before != Link::down && link() == Link::down)) break;
            if (!connection_.wait(next_step_ns(deadline))) break;
            now_ns_ = monotonic_now_ns();
        }
        return read(options_.sensors.empty() ? std::uint8_t{0} : options_.sensors.front());
    }

    /// `Options::max_age` from now on, for a sensor whose rate is another now.
    void set_max_age(nanoseconds max_age) noexcept { options_.max_age = max_age; }

    /// Why there is no connection, or what the server last complained of. A sentence, for a person.
    const char* error() const noexcept { return connection_.error().c_str(); }
    Link link() const noexcept { return connection_.link(); }
    bool connected() const noexcept { return link() == Link::up; }
    /// The server's sensors, as it described them when the subscription was made.
    const Description& description() const noexcept { return description_; }
    Counters counters(std::uint8_t place = 0) const noexcept {
        if (!sensors_) return {};
        return {sensors_[place].accounting.counts, sensors_[place].all_passed_over};
    }
    /// Connections made so far.
    std::uint32_t connections() const noexcept { return connections_; }
    /// How often a wanted sensor was reconfigured while connected: ranges, filters or rate may be others now.
    std::uint32_t reconfigurations() const noexcept { return reconfigurations_; }
    /// JSON messages that could not be understood; they were left out.
    std::uint64_t bad_messages() const noexcept { return bad_messages_; }
    /// For poll or epoll with other things; another one after a new connection, -1 without one.
    int fd() const noexcept { return connection_.fd(); }

protected:
    explicit Subscription(Options options)
        : options_(std::move(options)), sensors_(new (std::nothrow) SensorState[kPlaces]()),
          connection_(options_, encode_json(request(options_))), clock_name_(clock_name()) {}

private:
    static constexpr std::size_t kPlaces = 256;  // every value of the `sensor` byte
    static constexpr double kHighestRateHz = 1e6;
    static constexpr int kMostReads = 16;      // in one call of `update`
    static constexpr ssize_t kBacklog = 2048;  // received at once: more than any steady stream

    static std::string request(const Options& options) {
        std::string text = "{\"action\":\"subscribe\",\"every\":" + std::to_string(options.every) +
                           ",\"fresh_only\":" + (options.fresh_only ? "true" : "false");
        for (std::size_t i = 0; i < options.sensors.size(); ++i)
            text += (i == 0 ? ",\"sensors\":[" : ",") + std::to_string(options.sensors[i]);
        return text + (options.sensors.empty() ? "}" : "]}");
    }

    /// Whether there may be something to read, after a step towards a connection where that is this call's business.
    bool may_read() noexcept {
        if (options_.reconnect == Reconnect::when_told) return connected();
        if (link() < Link::subscribing) connection_.step(now_ns_);
        return link() >= Link::subscribing;
    }

    /// A step, and read as far as the reply, and no sample behind it: the first is for `next`.
    void advance() noexcept {
        if (link() < Link::subscribing) connection_.step(now_ns_);
        Frame frame;
        std::size_t budget = options_.max_bytes_per_call;
        do {
            while (link() == Link::subscribing && take_message(frame)) {
            }
        } while (link() == Link::subscribing && receive(budget) > 0 && budget > 0);
    }

    /// When there is something to do without anything arriving, `deadline` at the latest.
    std::int64_t next_step_ns(std::int64_t deadline) const noexcept {
        std::int64_t at = deadline;
        if (link() == Link::down && connection_.addresses() > 0) at = connection_.retry_at_ns();
        if (link() == Link::connecting || link() == Link::subscribing) at = connection_.attempt_ends_ns();
        return at < deadline ? at : deadline;
    }

    ssize_t receive(std::size_t& budget) noexcept {
        const ssize_t count = connection_.receive(budget, now_ns_);
        if (count > 0) received_ns_ = now_ns_;
        return count;
    }

    std::size_t take_messages() noexcept {
        Frame frame;
        std::size_t frames = 0;
        while (link() != Link::down && take_message(frame))
            if (frame.process_data) ++frames;
        return frames;
    }

    /// Take one message; false if there is no whole one. `frame.process_data` is null if it was no DATA.
    bool take_message(Frame& frame) noexcept {
        std::string_view text;
        frame.process_data = nullptr;
        const FrameDecoder::Found found = connection_.next(frame, text);
        if (found == FrameDecoder::Found::data) sensors_[frame.sensor].take(frame, received_ns_, same_clock_);
        if (found == FrameDecoder::Found::json) take(text);
        return found == FrameDecoder::Found::data || found == FrameDecoder::Found::json;
    }

    void take(std::string_view text) noexcept {
        const json::Value message = json::is_object(text) ? json::Value(text) : json::Value();
        bool ok = false;
        if (const json::Value event = message["event"])
            take_event(event, message);
        else if (!message["reply"] || !message["ok"].get(ok))
            ++bad_messages_;
        else if (!ok)
            take_refusal(message);
        else if (link() == Link::subscribing && message["reply"].is("subscribe"))
            take_description(message);
    }

    void take_event(json::Value event, json::Value message) noexcept {
        std::uint8_t place = 0;
        const bool of_a_sensor = message["sensor"].get(place);
        if (event.is("sensor_lost") && of_a_sensor) {
            sensors_[place].lost = true;
            message["message"].get(connection_.set_error());
        } else if (event.is("sensor_back") && of_a_sensor) {
            sensors_[place].lost = false;
            set_rate(place, message);
        } else if (event.is("reconfigured")) {
            const auto& wanted = options_.sensors;
            if (!of_a_sensor || wanted.empty() || std::memchr(wanted.data(), place, wanted.size())) ++reconfigurations_;
            if (of_a_sensor) set_rate(place, message);
        } else if (event.is("shutting_down")) {
            connection_.is_shutting_down();
        }
    }

    void take_refusal(json::Value message) noexcept {
        Message reason;
        message["error"]["message"].get(reason);
        connection_.complain("the server refused: ").add(reason.view());
        if (link() != Link::subscribing) return;
        refused_ = true;
        connection_.drop();
    }

    void take_description(json::Value message) noexcept {
        if (!read_description(message, description_)) {
            refused_ = true;
            return connection_.lose("the server speaks another version of the protocol");
        }
        const bool automatic = options_.age_from == AgeFrom::automatic;
        same_clock_ = automatic ? same_clock(connection_.fd(), message, clock_name_) : options_.age_from == AgeFrom::instant;
        connection_.granted();
        ++connections_;
        for (std::size_t i = 0; i < kPlaces; ++i) sensors_[i].begin(options_.every, options_.fresh_only);
        for (std::size_t i = 0; i < description_.sensor_count; ++i)
            set_rate(description_.sensors[i].sensor, description_.sensors[i].rate_hz);
    }

    /// What an event says of a sensor's rate; if it says nothing, the rate is what it was.
    void set_rate(std::uint8_t place, json::Value event) noexcept {
        double rate_hz = 0.0;
        if (event["rate_hz"].get(rate_hz) && rate_hz > 0.0 && rate_hz <= kHighestRateHz) sensors_[place].accounting.rate_hz = rate_hz;
    }

    void set_rate(std::uint8_t place, double rate_hz) noexcept {
        sensors_[place].accounting.rate_hz = rate_hz > 0.0 && rate_hz <= kHighestRateHz ? rate_hz : 0.0;
    }

    Reading read(std::uint8_t place) noexcept {
        Reading reading;
        reading.sensor = place;
        reading.connection = connections_;
        reading.more_waits = more_waits_;
        reading.condition = Condition::disconnected;
        if (sensors_) sensors_[place].read(reading, options_, connected(), now_ns_);
        return reading;
    }

    Options options_;
    std::unique_ptr<SensorState[]> sensors_;
    Connection connection_;
    ClockName clock_name_;  // ours
    Description description_;
    std::int64_t now_ns_ = 0, received_ns_ = 0;
    std::uint32_t connections_ = 0, reconfigurations_ = 0;
    std::uint64_t bad_messages_ = 0;
    bool same_clock_ = false, more_waits_ = false, refused_ = false;
};

}  // namespace bota_ethercat::detail

#endif  // BOTA_ETHERCAT_SUBSCRIPTION_HPP
