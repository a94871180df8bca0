// The newest reading, from the receiving thread to the control thread: neither waits for the other.
//
// Three places: one is written, one is read, and the third holds the newest that was written; an atomic exchange swaps it.
#pragma once

#include <array>
#include <atomic>
#include <cstdint>

#include <bota_ethercat/reading.hpp>

namespace bota_ethercat_hardware {

struct Received {
    bota_ethercat::Reading reading;
    bool is_checked = true;  ///< false: sensor or settings may be others than when they were accepted
    bool is_connected = true;
    std::int64_t at_ns = 0;  ///< CLOCK_MONOTONIC of the reading
    std::int64_t max_age_ns = 0;
};

class Latest {
public:
    /// For the writing thread: the place to write the next one to.
    Received& next() noexcept { return places_[written_]; }
    /// It is written.
    void publish() noexcept { written_ = newest_.exchange(written_ | kUnread, std::memory_order_acq_rel) & ~kUnread; }

    /// For the reading thread: the newest that was published; valid until the next call.
    const Received& take() noexcept {
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

}  // namespace bota_ethercat_hardware
