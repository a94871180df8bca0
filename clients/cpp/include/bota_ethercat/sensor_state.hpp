// What a client knows of one sensor: its newest frame, its newest sample, and what a reading makes of them.
#ifndef BOTA_ETHERCAT_SENSOR_STATE_HPP
#define BOTA_ETHERCAT_SENSOR_STATE_HPP

#include <array>
#include <cstddef>
#include <cstdint>
#include <cstring>

#include "bota_ethercat/accounting.hpp"
#include "bota_ethercat/framing.hpp"
#include "bota_ethercat/process_data.hpp"
#include "bota_ethercat/reading.hpp"
#include "bota_ethercat/text.hpp"

namespace bota_ethercat::detail {

class SensorState {
public:
    StreamAccounting accounting;
    bool lost = false;                  // says the server
    std::uint64_t all_passed_over = 0;  // since the client was made

    /// The sensor of a new connection.
    void begin(std::uint32_t every, bool fresh_only) noexcept {
        accounting.begin();
        accounting.configure(every, fresh_only);
        accounting.rate_hz = 0.0;
        lost = false;
    }

    /// A frame that was received at `received_ns`; `same_clock`: its stamps are of our CLOCK_MONOTONIC.
    void take(const Frame& frame, std::int64_t received_ns, bool same_clock) noexcept {
        const bool reconnected = seen_ && !accounting.begun();  // nobody knows what was lost meanwhile
        const std::uint64_t restarts = accounting.counts.restarts;
        const FrameKind kind = accounting.take(frame.sequence, frame.monotonic_ns, frame.flags);
        if (kind == FrameKind::old) return;
        if (reconnected || accounting.counts.restarts > restarts || (frame.flags & kGap) != 0) gap_ = true;
        newest_ = frame;
        newest_.process_data = nullptr;
        newest_received_ns_ = received_ns;
        seen_ = true;
        if (kind != FrameKind::sample) return;
        if (unread_) {
            ++passed_over_;
            ++all_passed_over;
        }
        sampled_ = newest_;
        std::memcpy(process_data_.data(), frame.process_data, frame.size);
        sampled_received_ns_ = received_ns;
        same_clock_ = same_clock;
        warnings_ |= little_endian<std::uint32_t>(frame.process_data + kWarningsAt);
        has_sample_ = unread_ = true;
        lost = false;
    }

    /// Fill in what this sensor knows, as of `now_ns`; the next reading begins.
    void read(Reading& reading, const Options& options, bool connected, std::int64_t now_ns) noexcept {
        reading.flags = newest_.flags;
        reading.wkc = newest_.wkc;
        reading.has_sample = has_sample_;
        reading.is_new = unread_;
        reading.gap = gap_;
        const StreamCounts& counts = accounting.counts;
        reading.withheld = counts.withheld - read_.withheld;
        reading.lost = counts.lost - read_.lost;
        read_ = counts;
        reading.passed_over = passed_over_;
        reading.warnings_seen = warnings_;
        unread_ = gap_ = false;
        passed_over_ = 0;
        warnings_ = 0;
        bool ahead = false;
        if (has_sample_) {
            reading.sequence = sampled_.sequence;
            reading.stamp_ns = sampled_.stamp_ns;
            reading.monotonic_ns = sampled_.monotonic_ns;
            reading.received_ns = sampled_received_ns_;
            (void)decode(process_data_.data(), sampled_.size, options.imu_units, reading.sample);
            reading.age_is_lower_bound = !same_clock_;
            const auto from = same_clock_ ? sampled_.monotonic_ns : static_cast<std::uint64_t>(sampled_received_ns_);
            const auto now = static_cast<std::uint64_t>(now_ns);
            ahead = from > now && from - now > static_cast<std::uint64_t>(kClockToleranceNs);
            if (!ahead) reading.age_ns = from < now ? static_cast<std::int64_t>(now - from) : 0;
        }
        const bool recent = has_sample_ && !ahead && reading.age_ns <= options.max_age.count();
        reading.condition = recent ? worth(reading.sample, options.judge_imu) : why_old(options.max_age, connected, now_ns, ahead);
    }

private:
    static constexpr std::int64_t kClockToleranceNs = 1'000'000;
    static constexpr std::int64_t kLeastSilenceNs = 30'000'000;  // three times the pace of REPEATED frames

    /// What a recent sample is worth.
    static Condition worth(const Sample& sample, bool judge_imu) noexcept {
        if (!sample.wrench_is_finite() || (judge_imu && !sample.imu_is_finite())) return Condition::not_finite;
        if (sample.wrench_is_saturated() || (judge_imu && sample.imu_is_saturated())) return Condition::saturated;
        return Condition::fresh;
    }

    /// Why there is no recent sample.
    Condition why_old(nanoseconds max_age, bool connected, std::int64_t now_ns, bool ahead) const noexcept {
        if (!connected) return Condition::disconnected;
        if (lost) return Condition::sensor_lost;
        const std::int64_t twice = after(max_age.count(), max_age);
        const std::int64_t silence = twice > kLeastSilenceNs ? twice : kLeastSilenceNs;
        if (!accounting.begun() || now_ns - newest_received_ns_ > silence) return Condition::silent;
        if ((newest_.flags & kInvalid) != 0) return Condition::invalid;
        if ((newest_.flags & kRepeated) != 0) return Condition::repeated;
        return ahead ? Condition::bad_clock : Condition::late;
    }

    Frame newest_;   // of any kind; no process data
    Frame sampled_;  // the newest that brought a sample
    std::array<std::uint8_t, kPdoSizeWithOrientation> process_data_{};
    std::int64_t newest_received_ns_ = 0, sampled_received_ns_ = 0;
    bool seen_ = false;  // any frame, on any connection
    bool has_sample_ = false, unread_ = false, gap_ = false;
    bool same_clock_ = false;  // of `sampled_`: another connection may lead to another machine
    std::uint64_t passed_over_ = 0;
    std::uint32_t warnings_ = 0;
    StreamCounts read_;  // when the last reading was taken
};

}  // namespace bota_ethercat::detail

#endif  // BOTA_ETHERCAT_SENSOR_STATE_HPP
