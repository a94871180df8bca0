// SPDX-License-Identifier: Apache-2.0
// The stream of samples: `Client`, all that a controller needs. The top of bota_ethercat.hpp has units, threads, real time.
#pragma once

#include <algorithm>
#include <chrono>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "bota_ethercat/connection.hpp"
#include "bota_ethercat/reading.hpp"

namespace bota_ethercat {

/// A subscription to the samples of one server. After the loss of the connection readings keep the last sample, whose age grows;
/// the first sample of a new connection has `gap`, and `connection` is one more. Host names are looked up in `connect` only.
/// A moved-from client can only be destroyed or assigned to.
class Client {
public:
    /// Allocates everything that is ever needed.
    explicit Client(Options options = {}) : connection_(options, encode_json(request(options))) {}
    Client(std::string host, std::uint16_t port) : Client(Options{std::move(host), port}) {}

    /// Connect and subscribe; waits. False if it did not succeed within `timeout` or was refused: `error` says why,
    /// and `latest` and `next`, or `reconnect`, may go on trying.
    bool connect(nanoseconds timeout = std::chrono::seconds(2)) noexcept {
        refused_ = false;
        return connection_.connect(timeout, [this](std::string_view text) { handle(text); });
    }

    /// A step of reconnecting, without waiting, one attempt per `reconnect_every`; true once connected.
    /// With `Reconnect::when_told` only this and `connect` do so: call it every few milliseconds.
    bool reconnect() noexcept {
        connection_.now_ns = monotonic_now_ns();
        connection_.advance([this](std::string_view text) { handle(text); });
        return connected();
    }

    /// End the connection; nothing is tried again until `connect`.
    void close() noexcept { connection_.close(); }

    /// Read what has arrived, without waiting. Returns how many DATA messages that were.
    std::size_t update() noexcept {
        connection_.now_ns = monotonic_now_ns();
        more_waits_ = false;
        if (!may_read()) return 0;
        std::size_t frames = 0, budget = connection_.options.max_bytes_per_call;
        bool may_be_more = true;
        for (int reads = 0;; ++reads) {
            Frame frame;
            while (link() != Link::down && read_message(frame)) frames += frame.process_data != nullptr;
            if (link() == Link::down || !may_be_more) break;
            if (budget == 0 || reads == kMaxReads) {
                more_waits_ = true;
                break;
            }
            const std::size_t count = connection_.receive(budget);
            if (count == 0) break;
            // A few messages are all there was. After a stall, reading makes room and more comes at once.
            may_be_more = count >= kBacklog || budget == 0;
        }
        return frames;
    }

    /// The newest sample of the sensor at this position, after reading everything that has arrived.
    Reading latest(std::uint8_t position = 0) noexcept {
        update();
        return read(position);
    }

    /// The same without reading the socket: for the second sensor of a chain, after `latest` of the first.
    Reading peek(std::uint8_t position = 0) noexcept {
        connection_.now_ns = monotonic_now_ns();
        return read(position);
    }

    /// The next sample of any sensor, in order, none left out; waits at most `timeout`.
    ///
    /// Without one the reading is what `latest` of the first wanted sensor would be: `is_new` is false, `condition`
    /// says why. Returns early when the connection is lost and when a signal handler ran; at once if there is no
    /// connection and nothing else may make one (`Reconnect::when_told`).
    Reading next(nanoseconds timeout) noexcept {
        const std::vector<std::uint8_t>& wanted = connection_.options.sensors;
        connection_.now_ns = monotonic_now_ns();
        more_waits_ = false;
        const std::int64_t deadline = detail::after(connection_.now_ns, timeout);
        for (bool has_read = false; may_read() || connection_.options.reconnect == Reconnect::by_itself;) {
            const Link before = link();
            Frame frame;
            while (before >= Link::subscribing && read_message(frame)) {
                if (frame.process_data && (frame.flags & (kRepeated | kInvalid)) == 0) return read(frame.sensor);
            }
            // A server that sends without end what is no sample does not hold this up.
            if (has_read && connection_.now_ns >= deadline) break;
            if (link() >= Link::subscribing) {
                std::size_t budget = connection_.options.max_bytes_per_call;
                has_read = true;
                if (connection_.receive(budget) > 0) continue;
            }
            if (connection_.now_ns >= deadline || (before != Link::down && link() == Link::down)) break;
            if (!connection_.wait(deadline)) break;
        }
        return read(wanted.empty() ? std::uint8_t{0} : wanted.front());
    }

    /// `Options::max_age` from now on, for a sensor whose rate is another now.
    void set_max_age(nanoseconds max_age) noexcept { connection_.options.max_age = max_age; }

    /// Why there is no connection, or the server's last error message. A sentence, for a person.
    const char* error() const noexcept { return connection_.error.c_str(); }
    Link link() const noexcept { return connection_.link; }
    bool connected() const noexcept { return link() == Link::up; }
    /// Whether the server refused the last subscription asked for.
    bool refused() const noexcept { return refused_; }
    /// The server's sensors, as it described them last: when the subscription was made, and a sensor's rate, settings and
    /// offset when it came back, was reconfigured or tared.
    const Description& description() const noexcept { return description_; }
    Counters counters(std::uint8_t position = 0) const noexcept {
        return {sensors_[position].accounting.counts, sensors_[position].all_passed_over};
    }
    /// Connections made so far.
    std::uint32_t connections() const noexcept { return connections_; }
    /// How often a wanted sensor was reconfigured while connected: ranges, filters or rate may be others now.
    std::uint32_t reconfigurations() const noexcept { return reconfigurations_; }
    /// JSON messages that could not be understood; they were left out.
    std::uint64_t bad_messages() const noexcept { return bad_messages_; }
    /// For poll or epoll with other things; another one after a new connection, -1 without one.
    int fd() const noexcept { return connection_.fd(); }

private:
    static constexpr std::size_t kPlaces = 256;    // every value of the `sensor` byte
    static constexpr int kMaxReads = 16;          // in one call of `update`
    static constexpr std::size_t kBacklog = 2048;  // received at once: more than any steady stream

    static std::string request(const Options& options) {
        std::string text = "{\"action\":\"subscribe\",\"every\":" + std::to_string(options.every) +
                           ",\"fresh_only\":" + (options.fresh_only ? "true" : "false");
        for (std::size_t i = 0; i < options.sensors.size(); ++i)
            text += (i == 0 ? ",\"sensors\":[" : ",") + std::to_string(options.sensors[i]);
        return text + (options.sensors.empty() ? "}" : "]}");
    }

    /// Whether there may be something to read; makes a step towards a connection if the client reconnects by itself.
    bool may_read() noexcept {
        if (connection_.options.reconnect == Reconnect::when_told) return connected();
        if (link() < Link::subscribing) connection_.step();
        return link() >= Link::subscribing;
    }

    /// Read and handle one message; false if there is no complete one. `frame.process_data` is null if it is not DATA.
    bool read_message(Frame& frame) noexcept {
        std::string_view text;
        frame.process_data = nullptr;
        const FrameDecoder::Found found = connection_.next(frame, text);
        if (found == FrameDecoder::Found::data) sensors_[frame.sensor].add(frame, connection_.received_ns, same_clock_);
        if (found == FrameDecoder::Found::json) handle(text);
        return found == FrameDecoder::Found::data || found == FrameDecoder::Found::json;
    }

    void handle(std::string_view text) noexcept {
        const json::Value message = json::is_object(text) ? json::Value(text) : json::Value();
        bool ok = false;
        if (const json::Value event = message["event"])
            handle_event(event, message);
        else if (!message["reply"] || !message["ok"].get(ok))
            ++bad_messages_;
        else if (!ok)
            handle_refusal(message);
        else if (link() == Link::subscribing && message["reply"].is("subscribe"))
            handle_description(message);
    }

    void handle_event(json::Value event, json::Value message) noexcept {
        std::uint8_t position = 0;
        const bool of_a_sensor = message["sensor"].get(position);
        if (event.is("shutting_down")) connection_.is_shutting_down = true;
        if (event.is("reconfigured")) {
            const auto& wanted = connection_.options.sensors;
            if (!of_a_sensor || wanted.empty() || std::count(wanted.begin(), wanted.end(), position) > 0) ++reconfigurations_;
        }
        if (!of_a_sensor) return;
        if (event.is("sensor_lost")) {
            sensors_[position].lost = true;
            message["message"].get(connection_.error);
        } else if (event.is("sensor_back") || event.is("reconfigured")) {
            sensors_[position].lost = false;
            if (SensorInfo* const info = described(position)) detail::read_in_force(message, *info);
            update_sensors();
        } else if (event.is("offset_changed")) {
            if (SensorInfo* const info = described(position)) detail::read_offset(message, *info);
        }
    }

    SensorInfo* described(std::uint8_t position) noexcept { return const_cast<SensorInfo*>(description_.find(position)); }

    void handle_refusal(json::Value message) noexcept {
        detail::Message reason;
        message["error"]["message"].get(reason);
        connection_.set_error("the server refused: ").add(reason.view());
        if (link() != Link::subscribing) return;
        refused_ = true;
        connection_.drop();
    }

    void handle_description(json::Value message) noexcept {
        if (!detail::read_description(message, description_)) {
            refused_ = true;
            return connection_.lose("the server speaks another version of the protocol");
        }
        const json::Value theirs = message["boot_id"];
        const bool is_named = theirs.is_string() && !clock_name_.empty();
        same_clock_ = is_named ? theirs.is(clock_name_) : connection_.has_one_address();
        refused_ = false;
        connection_.link = Link::up;
        connection_.error.clear();
        ++connections_;
        for (detail::ReceivedSensor& each : sensors_) each.begin(connection_.options.every, connection_.options.fresh_only);
        update_sensors();
    }

    /// By the description; a rate that is not known stays as it was.
    void update_sensors() noexcept {
        for (std::size_t i = 0; i < description_.sensor_count; ++i) {
            const SensorInfo& info = description_.sensors[i];
            if (info.rate_hz > 0.0) sensors_[info.sensor].accounting.rate_hz = info.rate_hz;
            sensors_[info.sensor].delay_ns = info.delay_ns;
        }
    }

    Reading read(std::uint8_t position) noexcept {
        Reading reading = sensors_[position].read(connection_.options, connected(), connection_.now_ns);
        reading.sensor = position;
        reading.connection = connections_;
        reading.more_waits = more_waits_;
        return reading;
    }

    detail::Connection connection_;
    std::vector<detail::ReceivedSensor> sensors_ = std::vector<detail::ReceivedSensor>(kPlaces);
    std::string clock_name_ = detail::clock_name();  // ours
    Description description_;
    std::uint32_t connections_ = 0, reconfigurations_ = 0;
    std::uint64_t bad_messages_ = 0;
    bool same_clock_ = false, more_waits_ = false, refused_ = false;
};

}  // namespace bota_ethercat
