// What a controller asks for and is told: `Options`, `Condition`, `Reading`, `Counters`.
#ifndef BOTA_ETHERCAT_READING_HPP
#define BOTA_ETHERCAT_READING_HPP

#include <chrono>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <string>
#include <vector>

#include "bota_ethercat/accounting.hpp"
#include "bota_ethercat/process_data.hpp"
#include "bota_ethercat/text.hpp"

namespace bota_ethercat {

/// Whether the newest sample may be used, and if not, why. The numbers are stable, and a higher one takes precedence.
///
/// 0 to 2: the sample is no older than `Options::max_age`, and they say what it is worth; the others: there is no such sample.
/// Judged is the newest sample only; `Reading::warnings_seen` has the warnings of those that `latest` passed over.
enum class Condition : std::uint8_t {
    fresh = 0,         ///< use it
    saturated = 1,     ///< the sensor was overloaded: force and torque are wrong, but `sample` has them
    not_finite = 2,    ///< a value is NaN or infinite
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
        case Condition::not_finite: return "not finite: the sensor sends NaN or infinity";
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

/// What the age of a sample is counted from.
enum class AgeFrom : std::uint8_t {
    automatic,  ///< the sample's instant if the server shares this machine's CLOCK_MONOTONIC, its arrival if not
    instant,    ///< `monotonic_ns`: server and client must share CLOCK_MONOTONIC
    arrival,    ///< the moment it was read from the socket: a lower bound of the age
};

/// Who makes a connection that was lost anew.
enum class Reconnect : std::uint8_t {
    by_itself,  ///< `latest`, `update` and `next`, a non-blocking step in each call
    when_told,  ///< only `Client::reconnect` and `connect`; without a connection the others just read the clock
};

struct Options {
    std::string host = "localhost";
    std::uint16_t port = 12001;
    std::vector<std::uint8_t> sensors{};  ///< positions on the bus; empty = all
    std::uint32_t every = 1;              ///< one frame in so many
    bool fresh_only = true;               ///< REPEATED frames only every 10 ms, to show that the sensor is silent
    ImuUnits imu_units = ImuUnits::g_dps;
    nanoseconds max_age = std::chrono::milliseconds(10);  ///< an older sample is never `Condition::fresh`
    bool judge_imu = false;  ///< `Condition` judges acceleration, angular rate and orientation too, not only force and torque
    Reconnect reconnect = Reconnect::by_itself;
    nanoseconds reconnect_every = std::chrono::milliseconds(100);  ///< shortest time between two attempts
    AgeFrom age_from = AgeFrom::automatic;
    std::size_t max_bytes_per_call = 262144;  ///< that `update` and `latest` read at most; some 2700 frames
    int receive_buffer = 65536;  ///< SO_RCVBUF: how much old data a stall can leave; at least 16384, 0 = the system's
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
    std::int64_t received_ns = 0;    ///< when it was read from the socket, CLOCK_MONOTONIC here
    std::int64_t age_ns = std::numeric_limits<std::int64_t>::max();  ///< of the sample, now; max = not known
    bool age_is_lower_bound = false;                                 ///< it counts from the arrival

    // Since the reading of this sensor before this one:
    bool gap = false;                   ///< samples were lost or withheld, or the connection was made anew
    std::uint64_t withheld = 0;         ///< frames that the server had and this client did not read in time
    std::uint64_t lost = 0;             ///< samples that the server never had; an estimate, at least one a gap
    std::uint64_t passed_over = 0;      ///< samples that came and that `latest` left out for a newer one
    std::uint32_t warnings_seen = 0;    ///< warnings of all samples, those passed over too: one can last one sample

    std::uint32_t connection = 0;  ///< counts connections; when it rises, the server may be another one
    bool more_waits = false;       ///< the bound of one call was met before everything was read: call again

    /// The one thing to ask before a sample is used to control something: it is recent, finite and not saturated. Who wants
    /// saturated samples too, to see which way an overload goes, asks for `condition == Condition::saturated`.
    bool fresh() const noexcept { return condition == Condition::fresh; }
};

/// Counts of one sensor since the client was made.
struct Counters : StreamCounts {
    std::uint64_t passed_over = 0;  ///< samples that `latest` left out for a newer one
};

}  // namespace bota_ethercat

#endif  // BOTA_ETHERCAT_READING_HPP
