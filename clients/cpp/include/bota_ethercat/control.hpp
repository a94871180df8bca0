// SPDX-License-Identifier: Apache-2.0
// `Control`: requests to a server, each on a connection of its own.
#pragma once

#include <array>
#include <charconv>
#include <chrono>
#include <cmath>
#include <string>
#include <string_view>
#include <utility>

#include "bota_ethercat/connection.hpp"

namespace bota_ethercat {

/// What `tare` did: force in N, then torque in Nm.
struct TareResult {
    std::array<double, 6> old_offset{}, new_offset{};
    std::array<double, 6> residual{};   ///< mean minus target afterwards
    std::array<double, 6> deviation{};  ///< standard deviation of a sample meanwhile
};

/// Requests to a server, each on a connection of its own, so that no stream is disturbed and another thread may ask (a tare
/// takes half a second). Waits and allocates: not for a control loop. Who may do what: docs/protocol.md.
class Control {
public:
    explicit Control(std::string host = "localhost", std::uint16_t port = 12001) : options_{std::move(host), port} {}

    /// Send any request, a JSON object such as `{"action":"sdo_read","index":32784}`, and wait for its reply.
    /// True if it was granted: `reply` has it. False: `error` says why, `error_code` is the server's if it refused.
    bool ask(std::string_view request, nanoseconds timeout = std::chrono::seconds(10)) {
        reply_.clear();
        code_.clear();
        abort_code_ = 0;
        if (!json::is_object(request)) return fail("the request is no JSON object");
        detail::Connection connection(options_, encode_json(request), timeout);
        const bool is_answered = connection.connect(timeout, [&](std::string_view text) {
            if (!json::is_object(text)) return connection.lose("the reply could not be understood");
            if (!json::Value(text)["reply"]) return;  // an event
            reply_ = text;
            connection.link = Link::up;
        });
        error_ = connection.error;
        if (!is_answered) return false;
        error_.clear();
        bool ok = false;
        if (reply()["ok"].get(ok) && ok) return true;
        const json::Value refusal = reply()["error"];
        refusal["code"].get(code_);
        refusal["abort_code"].get(abort_code_);
        return !refusal["message"].get(error_) && fail("the server refused without a reason");
    }

    bool describe(Description& into) {
        if (!ask("{\"action\":\"describe\"}")) return false;
        return detail::read_description(reply(), into) || fail("the server speaks another version of the protocol");
    }

    /// Set the sensor's own offset so that the mean of `samples` samples becomes `target` (N, Nm). The sensor must be
    /// stationary; it takes `samples` sample periods and some more.
    bool tare(TareResult& into, std::uint8_t position = 0, unsigned samples = 400, const std::array<double, 6>& target = {},
              nanoseconds timeout = std::chrono::seconds(60)) {
        std::string request = "{\"action\":\"tare\",\"sensor\":" + std::to_string(position) +
                              ",\"samples\":" + std::to_string(samples) + ",\"target\":";
        char separator = '[';
        for (const double value : target) {
            if (!is_finite(value)) return fail("the target of a tare must be six finite numbers");
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
        detail::start_error(error_, options_).add(why);
        return false;
    }

    Options options_;
    std::string reply_;
    detail::Message error_;
    Text<32> code_;
    std::uint32_t abort_code_ = 0;
};

}  // namespace bota_ethercat
