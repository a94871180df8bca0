// SPDX-License-Identifier: Apache-2.0
// What a controller is told: `Condition`, `Reading`, `Counters`; and what they are made of, `StreamAccounting`, `ReceivedSensor`.
#pragma once

#include <array>
#include <cmath>
#include <cstring>
#include <limits>
#include <optional>

#include "bota_ethercat/connection.hpp"

namespace bota_ethercat {

/// Whether the newest sample may be used, and if not, why. The numbers are stable, and a higher one takes precedence.
///
/// 0 to 2: the sample is no older than `Options::max_age`, and they say what it is worth; the others: there is no such sample.
/// Judged is the newest sample only; `Reading::warnings_seen` has the warnings of those that `latest` passed over.
enum class Condition : std::uint8_t {
    fresh = 0,         ///< use it
    saturated = 1,     ///< the sensor was overloaded: force and torque are wrong, but `sample` has them
    not_finite = 2,    ///< a value is NaN or infinite, or the sensor reports that its ADC or supply is at fault
    late = 3,          ///< samples arrive, but too old: a backlog, or a machine that is too slow
    bad_clock = 4,     ///< stamps ahead of this machine's clock: an age cannot be known
    repeated = 5,      ///< the sensor gives the same process data again and again
    invalid = 6,       ///< the working counter is short: the sensor does not answer on the bus
    silent = 7,        ///< connected, but nothing of this sensor arrives: the server is stopped or stuck
    sensor_lost = 8,   ///< the server says that the sensor is lost
    disconnected = 9,  ///< no connection; `Client::error` says why
};

inline const char* to_string(Condition condition) noexcept {
    switch (condition) {
        case Condition::fresh: return "fresh";
        case Condition::saturated: return "saturated: the sensor is overloaded";
        case Condition::not_finite: return "faulty: the sensor sends NaN or infinity, or reports that its ADC or supply is at fault";
        case Condition::late: return "late: what arrives is too old";
        case Condition::bad_clock: return "bad clock: the server's stamps are ahead of this machine's";
        case Condition::repeated: return "repeated: the sensor gives nothing new";
        case Condition::invalid: return "invalid: the sensor does not answer on the bus";
        case Condition::silent: return "silent: nothing arrives from the server";
        case Condition::sensor_lost: return "lost: the server says that the sensor is lost";
        case Condition::disconnected: return "disconnected";
    }
    return "?";
}

/// What a frame is. The words here and in `StreamCounts` are those of docs/protocol.md.
enum class FrameKind : std::uint8_t { sample, repeated, invalid, old };

/// Counts of one sensor's frames and samples: `protocol.accounting` in C++.
struct StreamCounts {
    std::uint64_t samples = 0;   ///< new and valid ones: `new`, which is taken in C++
    std::uint64_t repeated = 0;  ///< the sensor has nothing new
    std::uint64_t invalid = 0;   ///< the working counter was short
    std::uint64_t old = 0;       ///< duplicates and frames out of order; ignored
    std::uint64_t restarts = 0;  ///< the server's numbering began again
    std::uint64_t gaps = 0;      ///< frames with GAP
    std::uint64_t withheld = 0;  ///< sequence numbers of frames that this client did not read in time
    std::uint64_t lost = 0;      ///< samples that the server never had; an estimate
    std::uint64_t skipped = 0;   ///< sequence numbers that `every` and `fresh_only` left out

    std::uint64_t frames() const noexcept { return samples + repeated + invalid + old; }
};

/// Classifies and counts the frames of one sensor.
class StreamAccounting {
public:
    StreamCounts counts;
    double rate_hz = 0.0;     ///< the sensor's sampling rate, at most 1e6; 0 if it is unknown
    std::uint32_t every = 1;  ///< as subscribed
    bool fresh_only = true;

    /// A new subscription begins: nothing before its first frame counts as missing, unless it has GAP.
    void begin() noexcept { begun_ = has_new_ = false, missed_ = 0; }
    /// Whether a frame has come since.
    bool begun() const noexcept { return begun_; }

    /// Count the next frame; what it is.
    FrameKind count(std::uint64_t sequence, std::uint64_t monotonic_ns, std::uint8_t flags) noexcept {
        std::uint64_t jump = 0;
        if (begun_ && sequence <= sequence_) {
            if (monotonic_ns <= monotonic_ns_) {
                ++counts.old;
                return FrameKind::old;
            }
            ++counts.restarts;
        } else if (begun_) {
            jump = sequence - sequence_ - 1;
        }
        if (jump > 0 || (flags & kGap) != 0) count_missing(jump, monotonic_ns, (flags & kGap) != 0);
        sequence_ = sequence;
        monotonic_ns_ = monotonic_ns;
        begun_ = true;
        if ((flags & kInvalid) != 0) {
            ++counts.invalid;
            return FrameKind::invalid;
        }
        if ((flags & kRepeated) != 0) {
            ++counts.repeated;
            return FrameKind::repeated;
        }
        ++counts.samples;
        new_ns_ = monotonic_ns;
        has_new_ = true;
        missed_ = 0;
        return FrameKind::sample;
    }

private:
    void count_missing(std::uint64_t jump, std::uint64_t monotonic_ns, bool gap) noexcept {
        const std::uint64_t between = every > 0 ? every - 1 : 0;
        const std::uint64_t skipped = (fresh_only && !gap) || jump < between ? jump : between;
        counts.skipped += skipped;
        counts.withheld += jump - skipped;
        if (!gap) return;
        ++counts.gaps;
        std::uint64_t lost = jump > skipped ? 0 : 1;
        const std::uint64_t missed = jump + missed_;
        if (has_new_ && rate_hz > 0.0 && monotonic_ns > new_ns_) {
            const double periods = std::nearbyint(static_cast<double>(monotonic_ns - new_ns_) * rate_hz / 1e9);
            const std::uint64_t room = periods < 1.0 ? 0 : static_cast<std::uint64_t>(periods) - 1;
            if (room > missed && room - missed > lost) lost = room - missed;
        }
        counts.lost += lost;
        missed_ = missed + lost;
    }

    std::uint64_t sequence_ = 0, monotonic_ns_ = 0, new_ns_ = 0;
    std::uint64_t missed_ = 0;  // what is missing already since the newest new frame
    bool begun_ = false, has_new_ = false;
};

/// What is known of a sensor at the moment of a call.
struct Reading {
    Sample sample;            ///< the newest that was new and valid; zeros if `has_sample` is false
    bool has_sample = false;  ///< there has been one
    bool is_new = false;      ///< no call before returned this sample
    Condition condition = Condition::silent;

    std::uint8_t sensor = 0;         ///< position on the bus
    std::uint8_t flags = 0;          ///< of the newest frame, which may be REPEATED or INVALID and bring no sample
    std::uint16_t wkc = 0;           ///< of the newest frame
    std::uint64_t sequence = 0;      ///< of the sample
    std::uint64_t stamp_ns = 0;      ///< of the sample, CLOCK_REALTIME
    std::uint64_t monotonic_ns = 0;  ///< of the sample, CLOCK_MONOTONIC of the server's machine
    Delays delay_ns{};               ///< of the filters with which the sample was made
    std::int64_t received_ns = 0;    ///< when it was read from the socket, CLOCK_MONOTONIC here
    std::int64_t age_ns = std::numeric_limits<std::int64_t>::max();  ///< of the sample, now; max = not known
    bool age_is_lower_bound = false;                                 ///< it counts from the arrival

    // Since the reading of this sensor before this one:
    bool gap = false;                   ///< samples were lost or withheld, or the connection was lost
    std::uint64_t withheld = 0;         ///< frames that the server had and this client did not read in time
    std::uint64_t lost = 0;             ///< samples that the server never had; an estimate, at least one a gap
    std::uint64_t passed_over = 0;      ///< samples that came and that `latest` left out for a newer one
    std::uint32_t warnings_seen = 0;    ///< warnings of all samples, those passed over too: one can last one sample

    std::uint32_t connection = 0;  ///< counts connections; when it rises, the server may be another one
    bool more_waits = false;       ///< the bound of one call was met before everything was read: call again

    /// The one thing to ask before a sample is used to control something: it is recent, finite and not saturated. Who wants
    /// saturated samples too, to see which way an overload goes, asks for `condition == Condition::saturated`.
    bool fresh() const noexcept { return condition == Condition::fresh; }

    /// When it was measured, CLOCK_REALTIME: `stamp_ns` less the group delay. None: no sample, or the delay is not known.
    std::optional<std::uint64_t> measured_ns(Channel channel = Channel::force_torque) const noexcept {
        const auto delay = delay_ns[static_cast<std::size_t>(channel)];
        if (!has_sample || !delay) return std::nullopt;
        return stamp_ns - static_cast<std::uint64_t>(*delay);
    }
};

/// Counts of one sensor since the client was made.
struct Counters : StreamCounts {
    std::uint64_t passed_over = 0;  ///< samples that `latest` left out for a newer one
};

namespace detail {

/// What a client knows of one sensor: its newest frame, its newest sample, and what a reading makes of them. As in
/// protocol/bota_ethercat/client/reading.py.
class ReceivedSensor {
public:
    StreamAccounting accounting;
    Delays delay_ns{};
    bool lost = false;                  // says the server
    std::uint64_t all_passed_over = 0;  // in readings so far

    /// The sensor of a new connection.
    void begin(std::uint32_t every, bool fresh_only) noexcept {
        reconnected_ = accounting.counts.frames() > 0;  // what was lost meanwhile is not known
        accounting.begin();
        accounting.every = every;
        accounting.fresh_only = fresh_only;
        lost = false;
    }

    /// Add a frame that was received at `received_ns`; `same_clock`: its stamps are of our CLOCK_MONOTONIC. GAP of a frame that
    /// brings no sample is carried to the next that does.
    void add(const Frame& frame, std::int64_t received_ns, bool same_clock) noexcept {
        const std::uint64_t restarts = accounting.counts.restarts;
        const FrameKind kind = accounting.count(frame.sequence, frame.monotonic_ns, frame.flags);
        if (kind == FrameKind::old) return;
        if (reconnected_ || accounting.counts.restarts > restarts || (frame.flags & kGap) != 0) carried_gap_ = true;
        reconnected_ = false;
        next_.flags = frame.flags;
        next_.wkc = frame.wkc;
        received_ns_ = received_ns;
        if (kind != FrameKind::sample) return;
        next_.passed_over += next_.is_new ? 1 : 0;
        next_.has_sample = next_.is_new = true;
        next_.sequence = frame.sequence;
        next_.stamp_ns = frame.stamp_ns;
        next_.monotonic_ns = frame.monotonic_ns;
        next_.received_ns = received_ns;
        next_.delay_ns = delay_ns;
        next_.age_is_lower_bound = !same_clock;  // another connection may lead to another machine
        next_.warnings_seen |= little_endian<std::uint32_t>(frame.process_data + kWarningsAt);
        next_.gap = next_.gap || carried_gap_;
        std::memcpy(process_data_.data(), frame.process_data, frame.size);
        size_ = frame.size;
        carried_gap_ = lost = false;
    }

    /// What is known of the sensor as of `now_ns`; the next reading begins.
    Reading read(const Options& options, bool connected, std::int64_t now_ns) noexcept {
        Reading reading = next_;
        reading.gap = next_.gap || carried_gap_;
        reading.withheld = accounting.counts.withheld - read_.withheld;
        reading.lost = accounting.counts.lost - read_.lost;
        read_ = accounting.counts;
        all_passed_over += next_.passed_over;
        next_.is_new = next_.gap = false;
        next_.passed_over = next_.warnings_seen = 0;
        bool ahead = false;
        if (reading.has_sample) {
            (void)decode(process_data_.data(), size_, options.imu_units, reading.sample);
            const auto received = static_cast<std::uint64_t>(reading.received_ns);
            const auto from = reading.age_is_lower_bound ? received : reading.monotonic_ns;
            const auto now = static_cast<std::uint64_t>(now_ns);
            ahead = from > now && from - now > kClockToleranceNs;
            if (!ahead) reading.age_ns = from < now ? static_cast<std::int64_t>(now - from) : 0;
        }
        const std::int64_t max_age_ns = options.max_age.count();
        const bool recent = reading.has_sample && !ahead && reading.age_ns <= max_age_ns;
        reading.condition = recent ? condition_of(reading.sample, options.judge_imu) : why_old(max_age_ns, connected, now_ns, ahead);
        return reading;
    }

private:
    static constexpr std::uint64_t kClockToleranceNs = 1'000'000;
    static constexpr std::int64_t kMinSilenceNs = 30'000'000;  // three times the pace of REPEATED frames

    /// The condition of a recent sample, by the table of protocol/bota_ethercat/stream/usable.py.
    static Condition condition_of(const Sample& sample, bool judge_imu) noexcept {
        if (!sample.wrench_is_finite() || sample.wrench_is_faulty()) return Condition::not_finite;
        if (judge_imu && (!sample.imu_is_finite() || sample.imu_is_faulty())) return Condition::not_finite;
        if (sample.wrench_is_saturated() || (judge_imu && sample.imu_is_saturated())) return Condition::saturated;
        return Condition::fresh;
    }

    /// Why there is no recent sample.
    Condition why_old(std::int64_t max_age_ns, bool connected, std::int64_t now_ns, bool ahead) const noexcept {
        if (!connected) return Condition::disconnected;
        if (lost) return Condition::sensor_lost;
        const std::int64_t silence_ns = now_ns - received_ns_;
        if (!accounting.begun() || (silence_ns >= kMinSilenceNs && silence_ns / 2 >= max_age_ns)) return Condition::silent;
        if ((next_.flags & kInvalid) != 0) return Condition::invalid;
        if ((next_.flags & kRepeated) != 0) return Condition::repeated;
        return ahead ? Condition::bad_clock : Condition::late;
    }

    Reading next_;  // without what depends on the moment of the call
    std::array<std::uint8_t, kPdoSizeWithOrientation> process_data_{};  // of the newest sample
    std::size_t size_ = 0;
    std::int64_t received_ns_ = 0;  // of the newest frame of any kind
    bool reconnected_ = false, carried_gap_ = false;
    StreamCounts read_;  // when the last reading was taken
};

}  // namespace detail

}  // namespace bota_ethercat
