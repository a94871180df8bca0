// What controllers see in each condition: `Gate` turns a reading into the values of the state interfaces and a verdict.
//
// For the control thread: no allocation, no locks, no system calls.
#pragma once

#include <cstdint>
#include <limits>

#include "bota_ethercat_hardware/latest.hpp"
#include "bota_ethercat_hardware/parameters.hpp"
#include "bota_ethercat_hardware/signals.hpp"

namespace bota_ethercat_hardware {

/// The `condition` while settings or sensor are others than when the samples were last accepted; beside bota_ethercat's.
inline constexpr int kUnchecked = 100;

inline const char* condition_text(int condition) noexcept {
    if (condition == kUnchecked) return "unchecked: the sensor's settings were changed";
    return to_string(static_cast<bota_ethercat::Condition>(condition));
}

/// The policy as the URDF has it: what to do in a condition.
inline Reaction reaction(const Parameters& parameters, int condition) noexcept {
    using bota_ethercat::Condition;
    if (condition == kUnchecked) return parameters.on_invalid;
    switch (static_cast<Condition>(condition)) {
        case Condition::fresh: return Reaction::use;
        case Condition::saturated: return parameters.on_saturated;
        case Condition::invalid:
        case Condition::not_finite:
        case Condition::bad_clock: return parameters.on_invalid;
        case Condition::late:
        case Condition::repeated:
        case Condition::sensor_lost:
        case Condition::silent:
        case Condition::disconnected: return parameters.on_stale;
    }
    return Reaction::error;
}

class Gate {
public:
    explicit Gate(const Parameters& parameters) noexcept
        : parameters_(parameters),
          error_after_ns_(parameters.error_after < 1e9 ? static_cast<std::int64_t>(parameters.error_after * 1e9) : kNever) {
        values_.fill(kNaN);
        values_[kAge] = std::numeric_limits<double>::infinity();
    }

    /// True: the values may be used, or are what the policy has for a moment. False: it is an error.
    bool take(const Received& received, std::int64_t now_ns) noexcept {
        using bota_ethercat::Condition;
        const bota_ethercat::Reading& reading = received.reading;
        if (reading.has_sample) sampled_ns_ = reading.age_ns == kNever ? kNever : received.at_ns - reading.age_ns;
        condition_ = static_cast<int>(reading.condition);
        if (reading.condition <= Condition::not_finite && now_ns - sampled_ns_ > received.max_age_ns)  // it has grown old since
            condition_ = static_cast<int>(received.is_connected ? Condition::late : Condition::disconnected);
        else if (!received.is_checked && reading.condition <= Condition::saturated)
            condition_ = kUnchecked;
        values_[kAge] = sampled_ns_ == kNever ? std::numeric_limits<double>::infinity()
                                              : static_cast<double>(now_ns - sampled_ns_) * 1e-9;
        values_[kCondition] = condition_;
        const Reaction doing = reaction(parameters_, condition_);
        if (doing == Reaction::use) {
            fill(reading.sample, values_);
            trouble_ns_ = kNever;
            return true;
        }
        if (trouble_ns_ == kNever) trouble_ns_ = now_ns;
        const bool bearable = doing != Reaction::error && (error_after_ns_ == kNever || now_ns - trouble_ns_ < error_after_ns_);
        if (doing != Reaction::hold || !bearable) fill_nan(values_);
        return bearable;
    }

    const Values& values() const noexcept { return values_; }
    int condition() const noexcept { return condition_; }
    /// Whether the values are those of a sample that the policy lets through.
    bool usable() const noexcept { return reaction(parameters_, condition_) == Reaction::use; }
    /// `error_after` counts from the next reading.
    void restart() noexcept { trouble_ns_ = kNever; }

private:
    static constexpr std::int64_t kNever = std::numeric_limits<std::int64_t>::max();

    const Parameters& parameters_;
    std::int64_t error_after_ns_;
    Values values_{};
    int condition_ = static_cast<int>(bota_ethercat::Condition::silent);
    std::int64_t sampled_ns_ = kNever;  // the instant of the newest sample, CLOCK_MONOTONIC; it outlives a connection
    std::int64_t trouble_ns_ = kNever;  // since when nothing was usable
};

}  // namespace bota_ethercat_hardware
