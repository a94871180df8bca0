// What a frame is, and what was lost or withheld before it: the counts of docs/protocol.md.
#ifndef BOTA_ETHERCAT_ACCOUNTING_HPP
#define BOTA_ETHERCAT_ACCOUNTING_HPP

#include <cmath>
#include <cstdint>

#include "bota_ethercat/process_data.hpp"

namespace bota_ethercat {

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
    double rate_hz = 0.0;  ///< the sensor's sampling rate, at most 1e6; 0 if it is unknown

    /// What was subscribed.
    void configure(std::uint32_t every, bool fresh_only) noexcept { every_ = every, fresh_only_ = fresh_only; }

    /// A new subscription begins: nothing before its first frame counts as missing, unless it has GAP.
    void begin() noexcept { begun_ = has_new_ = false; }
    /// Whether a frame has come since.
    bool begun() const noexcept { return begun_; }

    FrameKind take(std::uint64_t sequence, std::uint64_t monotonic_ns, std::uint8_t flags) noexcept {
        std::uint64_t jump = 0;
        if (begun_ && sequence <= sequence_) {
            if (monotonic_ns <= monotonic_ns_) return ++counts.old, FrameKind::old;
            ++counts.restarts;
        } else if (begun_) {
            jump = sequence - sequence_ - 1;
        }
        if (jump > 0 || (flags & kGap) != 0) count_missing(jump, monotonic_ns, (flags & kGap) != 0);
        sequence_ = sequence;
        monotonic_ns_ = monotonic_ns;
        begun_ = true;
        if ((flags & kInvalid) != 0) return ++counts.invalid, FrameKind::invalid;
        if ((flags & kRepeated) != 0) return ++counts.repeated, FrameKind::repeated;
        new_ns_ = monotonic_ns;
        has_new_ = true;
        return ++counts.samples, FrameKind::sample;
    }

private:
    void count_missing(std::uint64_t jump, std::uint64_t monotonic_ns, bool gap) noexcept {
        const std::uint64_t between = every_ > 0 ? every_ - 1 : 0;
        const std::uint64_t skipped = (fresh_only_ && !gap) || jump < between ? jump : between;
        counts.skipped += skipped;
        counts.withheld += jump - skipped;
        if (!gap) return;
        ++counts.gaps;
        std::uint64_t lost = jump > skipped ? 0 : 1;
        if (has_new_ && rate_hz > 0.0 && monotonic_ns > new_ns_) {
            const double periods = std::nearbyint(static_cast<double>(monotonic_ns - new_ns_) * rate_hz / 1e9);
            const std::uint64_t room = periods < 1.0 ? 0 : static_cast<std::uint64_t>(periods) - 1;
            if (room > jump && room - jump > lost) lost = room - jump;
        }
        counts.lost += lost;
    }

    std::uint64_t sequence_ = 0, monotonic_ns_ = 0, new_ns_ = 0;
    std::uint32_t every_ = 1;
    bool fresh_only_ = true, begun_ = false, has_new_ = false;
};

}  // namespace bota_ethercat

#endif  // BOTA_ETHERCAT_ACCOUNTING_HPP
