// `Control`: requests to a server, each on a connection of its own.
#ifndef BOTA_ETHERCAT_CONTROL_HPP
#define BOTA_ETHERCAT_CONTROL_HPP

#include <array>
#include <charconv>
#include <chrono>
#include <cerrno>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <string>
#include <string_view>
#include <utility>

#include "bota_ethercat/description.hpp"
#include "bota_ethercat/framing.hpp"
#include "bota_ethercat/json.hpp"
#include "bota_ethercat/socket.hpp"
#include "bota_ethercat/text.hpp"

namespace bota_ethercat {

/// Counters of one sensor, from `status`.
struct SensorStatus {
    std::uint8_t sensor = 0;
    std::uint64_t fresh = 0, repeated = 0, invalid = 0, lost_samples = 0, recoveries = 0;
    bool locked = false;     ///< the server follows the sensor's clock
    double period_us = 0.0;  ///< of the sensor's samples
};

/// Counters of the server, from `status`.
struct Status {
    std::uint64_t cycles = 0, missed_deadlines = 0, lost_frames = 0;
    double uptime_s = 0.0;
    std::size_t sensor_count = 0;
    std::array<SensorStatus, kMaxSensors> sensors;
};

/// What `tare` did: force in N, then torque in Nm.
struct TareResult {
    std::array<double, 6> old_offset{}, new_offset{};
    std::array<double, 6> residual{};   ///< mean minus target afterwards
    std::array<double, 6> deviation{};  ///< standard deviation of a sample meanwhile
};

namespace detail {

inline bool read(json::Value reply, Status& into) noexcept {
    if (!reply["sensors"].is_array()) return false;
    into = Status();
    reply["cycles"].get(into.cycles);
    reply["missed_deadlines"].get(into.missed_deadlines);
    reply["lost_frames"].get(into.lost_frames);
    reply["uptime_s"].get(into.uptime_s);
    json::Value each;
    for (json::Items items(reply["sensors"]); into.sensor_count < kMaxSensors && items.next(each);) {
        SensorStatus& status = into.sensors[into.sensor_count++];
        each["sensor"].get(status.sensor);
        each["fresh"].get(status.fresh);
        each["repeated"].get(status.repeated);
        each["invalid"].get(status.invalid);
        each["lost_samples"].get(status.lost_samples);
        each["recoveries"].get(status.recoveries);
        status.locked = each["clock"]["mode"].is("locked");
        each["clock"]["period_us"].get(status.period_us);
    }
    return true;
}

inline bool read(json::Value six, std::array<double, 6>& into) noexcept {
    std::size_t count = 0;
    json::Value each;
    for (json::Items items(six); items.next(each); ++count)
        if (count == into.size() || !each.get(into[count])) return false;
    return count == into.size();
}

}  // namespace detail

/// Requests to a server, each on a connection of its own, so that no stream is disturbed and another thread may ask (a tare
/// takes half a second). Waits and allocates: not for a control loop. Who may do what: docs/protocol.md.
class Control {
public:
    explicit Control(std::string host = "localhost", std::uint16_t port = 12001) : host_(std::move(host)), port_(port) {}

    /// Send any request, a JSON object such as `{"action":"sdo_read","index":32784}`, and wait for its reply.
    /// True if it was granted: `reply` has it. False: `error` says why, `error_code` is the server's word if it refused.
    bool ask(std::string_view request, nanoseconds timeout = std::chrono::seconds(10)) {
        const std::int64_t deadline = detail::after(monotonic_now_ns(), timeout);
        reply_.clear();
        error_.clear();
        code_.clear();
        abort_code_ = 0;
        if (!json::is_object(request)) return fail("the request is no JSON object");
        detail::Socket socket;
        detail::Addresses addresses;
        if (!addresses.resolve(host_, port_, error_) || !connect(socket, addresses, deadline)) return false;
        const std::string message = encode_json(request);
        if (!socket.send(message)) return fail("the request could not be sent");
        FrameDecoder decoder;
        if (!decoder.usable()) return fail("not enough memory");
        return await(socket, decoder, deadline) && judge();
    }

    bool describe(Description& into) {
        if (!ask("{\"action\":\"describe\"}")) return false;
        return detail::read_description(reply(), into) || fail("the server speaks another version of the protocol");
    }

    bool status(Status& into) {
        if (!ask("{\"action\":\"status\"}")) return false;
        return detail::read(reply(), into) || fail("the reply to status has no sensors");
    }

    /// Set the sensor's own offset so that the mean of `samples` samples becomes `target` (N, Nm). The sensor must be
    /// stationary; it takes `samples` sample periods and some more.
    bool tare(TareResult& into, std::uint8_t place = 0, unsigned samples = 400, const std::array<double, 6>& target = {},
              nanoseconds timeout = std::chrono::seconds(60)) {
        std::string request = "{\"action\":\"tare\",\"sensor\":" + std::to_string(place) +
                              ",\"samples\":" + std::to_string(samples) + ",\"target\":";
        char separator = '[';
        for (const double value : target) {
            if (!std::isfinite(value)) return fail("the target of a tare must be six finite numbers");
            std::array<char, 40> digits{};
            const auto done = std::to_chars(digits.data(), digits.data() + digits.size(), value);
            request += separator;
            request.append(digits.data(), done.ptr);
            separator = ',';
        }
        if (!ask(request + "]}", timeout)) return false;
        const json::Value result = reply();
        return (detail::read(result["old_offset"], into.old_offset) && detail::read(result["new_offset"], into.new_offset) &&
                detail::read(result["residual"], into.residual) && detail::read(result["deviation"], into.deviation)) ||
               fail("the reply to tare lacks six numbers");
    }

    /// The reply that granted or refused the last request; valid until the next one.
    json::Value reply() const noexcept { return json::Value(reply_); }
    /// Why the last request failed. A sentence, for a person; empty if it did not.
    const char* error() const noexcept { return error_.c_str(); }
    /// `bad_request`, `denied`, `busy`, `not_ready`, `sensor`, ...; empty if it was not the server that refused.
    std::string_view error_code() const noexcept { return code_.view(); }
    /// Of an `error_code` `sensor`: the SDO abort code.
    std::uint32_t abort_code() const noexcept { return abort_code_; }

private:
    bool fail(std::string_view why) noexcept {
        error_.clear();
        error_.add(host_).add(" port ").add(std::int64_t{port_}).add(": ").add(why);
        return false;
    }

    bool fail(int error_number) noexcept {
        (void)fail(error_number == 0 ? "the server closed the connection" : "");
        if (error_number != 0) detail::describe_errno(error_, error_number);
        return false;
    }

    bool connect(detail::Socket& socket, const detail::Addresses& addresses, std::int64_t deadline) noexcept {
        for (std::size_t i = 0; i < addresses.count; ++i) {
            int failed = socket.begin(addresses.address[i], addresses.length[i], 0);
            while (failed == 0 && monotonic_now_ns() < deadline) {
                if (socket.connected(failed)) return true;
                if (failed == 0) (void)socket.wait(true, deadline);
            }
            (void)fail(failed == 0 ? ETIMEDOUT : failed);
        }
        return false;
    }

    bool await(detail::Socket& socket, FrameDecoder& decoder, std::int64_t deadline) {
        Frame frame;
        std::string_view text;
        while (monotonic_now_ns() < deadline) {
            for (;;) {
                const FrameDecoder::Found found = decoder.next(frame, text);
                if (found == FrameDecoder::Found::nothing) break;
                if (found == FrameDecoder::Found::broken) return fail("what answers there is not ethercat-server");
                if (found != FrameDecoder::Found::json) continue;
                if (!json::is_object(text)) return fail("the reply could not be understood");
                if (!json::Value(text)["reply"]) continue;  // an event
                reply_ = text;
                return true;
            }
            std::size_t room = 0;
            int failed = 0;
            std::uint8_t* const into = decoder.space(room);
            const ssize_t count = socket.receive(into, room, failed);
            if (count < 0) return fail(failed);
            if (count > 0)
                decoder.received(static_cast<std::size_t>(count));
            else
                (void)socket.wait(false, deadline);
        }
        return fail("the server did not answer in time");
    }

    bool judge() noexcept {
        const json::Value answer = reply();
        bool ok = false;
        if (answer["ok"].get(ok) && ok) return true;
        const json::Value refusal = answer["error"];
        refusal["code"].get(code_);
        refusal["abort_code"].get(abort_code_);
        if (!refusal["message"].get(error_)) (void)fail("the server refused without a reason");
        return false;
    }

    std::string host_;
    std::uint16_t port_;
    std::string reply_;
    detail::Message error_;
    Text<32> code_;
    std::uint32_t abort_code_ = 0;
};

}  // namespace bota_ethercat

#endif  // BOTA_ETHERCAT_CONTROL_HPP
