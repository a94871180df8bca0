// Samples of Bota Systems EtherCAT force/torque sensors from ethercat-server, for controllers in C++17.
//
//     bota_ethercat::Client sensor("localhost", 12001);
//     if (!sensor.connect()) { std::fprintf(stderr, "%s\n", sensor.error()); return 1; }
//     while (running) {
//         const bota_ethercat::Reading reading = sensor.latest();   // never blocks, never allocates
//         if (reading.fresh()) control(reading.sample.force, reading.sample.torque);
//         else stop_safely(to_string(reading.condition));
//     }
//
// One header, Linux, libc only. Protocol version 1 (docs/protocol.md); docs/cpp.md is the manual.
//
// Units and frames. Force N, torque Nm, acceleration m/s^2, angular rate rad/s, temperature degrees Celsius; all in
//   the sensor's own frame, neither filtered nor compensated. A stationary sensor measures +g along the axis that points up.
// Age. CLOCK_MONOTONIC now minus the sample's, as the server stamps it. Only a frame that is neither
//   INVALID nor REPEATED brings a sample; the age of an older one grows, whatever else arrives. From another machine,
//   whose CLOCK_MONOTONIC is not ours, the age counts from the arrival and is only a lower bound.
// Real time. `latest`, `update`, `peek` and `next` throw nothing, allocate nothing and take no locks. `latest` and
//   `update` do not block: in the steady state one recv() and two clock_gettime(); never more than 16 and `max_bytes_per_call`.
//   While the connection is down a call makes one non-blocking step of reconnecting, one attempt per `reconnect_every`.
//   Everything else (constructor, `connect`, `Control`) allocates and waits.
// Threads. None of its own. An object is used by one thread at a time; objects share nothing.
// Network input is not trusted: lengths, depth and numbers are limited as in protocol/framing.py, and a server that breaks
//   the framing is disconnected.
// Contents. Stream: process data, framing, accounting, `Client`. Control: `Control`, one request per connection. Both use
//   JSON, descriptions and sockets, between them.
#ifndef BOTA_ETHERCAT_HPP
#define BOTA_ETHERCAT_HPP

#include <arpa/inet.h>
#include <fcntl.h>
#include <netdb.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <sys/socket.h>
#include <sys/types.h>
#include <time.h>
#include <unistd.h>

#include <array>
#include <cerrno>
#include <charconv>
#include <chrono>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <limits>
#include <memory>
#include <new>
#include <string>
#include <string_view>
#include <system_error>
#include <utility>
#include <vector>

#if !defined(__cpp_lib_to_chars) || __cpp_lib_to_chars < 201611L
#error "bota_ethercat.hpp needs std::from_chars for double: use g++ 11 or newer, or clang with libstdc++"
#endif

namespace bota_ethercat {

// ---------------------------------------------------------------------------------------------- utilities

using std::chrono::nanoseconds;

inline constexpr int kProtocolVersion = 1;
inline constexpr std::size_t kMaxJsonLength = 65536;  // bytes of one JSON message, as protocol/framing.py
inline constexpr int kMaxJsonDepth = 32;              // containers in each other
inline constexpr std::size_t kMaxJsonDigits = 4300;   // of a whole number: Python's own limit
inline constexpr std::size_t kMaxSensors = 16;        // of which a description is kept
inline constexpr double kStandardGravity = 9.80665;   // m/s^2 in one g
inline constexpr double kPi = 3.14159265358979323846;

/// CLOCK_MONOTONIC in ns: what intervals and ages are measured with.
inline std::int64_t monotonic_now_ns() noexcept {
    timespec now{};
    clock_gettime(CLOCK_MONOTONIC, &now);
    return std::int64_t{now.tv_sec} * 1'000'000'000 + now.tv_nsec;
}

/// A short NUL-terminated text without allocation. What does not fit is cut off between two characters.
template <std::size_t Size>
class Text {
public:
    const char* c_str() const noexcept { return text_.data(); }
    std::string_view view() const noexcept { return {text_.data(), length_}; }
    bool empty() const noexcept { return length_ == 0; }
    void clear() noexcept { length_ = 0, text_[0] = '\0'; }

    /// Add a text. What comes from the network may hold control characters: they become '?'.
    Text& add(std::string_view more) noexcept {
        for (const char c : more) {
            if (length_ + 1 >= Size) {
                cut_back();
                break;
            }
            const auto byte = static_cast<unsigned char>(c);
            text_[length_++] = byte < 0x20 || byte == 0x7f ? '?' : c;
        }
        text_[length_] = '\0';
        return *this;
    }

    Text& add(std::int64_t number) noexcept {
        std::array<char, 24> digits{};
        const auto done = std::to_chars(digits.data(), digits.data() + digits.size(), number);
        return add({digits.data(), static_cast<std::size_t>(done.ptr - digits.data())});
    }

private:
    void cut_back() noexcept {  // an unfinished UTF-8 sequence at the end
        std::size_t at = length_;
        while (at > 0 && (static_cast<unsigned char>(text_[at - 1]) & 0xC0) == 0x80) --at;
        if (at == 0) return;
        const auto lead = static_cast<unsigned char>(text_[at - 1]);
        const std::size_t needs = lead < 0x80 ? 1 : lead < 0xE0 ? 2 : lead < 0xF0 ? 3 : 4;
        if (length_ - (at - 1) < needs) length_ = at - 1;
    }

    std::array<char, Size> text_{};
    std::size_t length_ = 0;
};

// ---------------------------------------------------------------------------------------------- process data

/// Bits of `Reading::flags`.
inline constexpr std::uint8_t kRepeated = 1;  // same process data as the frame before: the sensor is silent
inline constexpr std::uint8_t kInvalid = 2;   // working counter short: the process data is the last good one
inline constexpr std::uint8_t kGap = 4;       // samples were lost, or withheld from this client, before this one

/// Bits of `Sample::warnings`; 7 to 31 are reserved.
inline constexpr std::uint32_t kForceTorqueSaturated = 1u << 0;
inline constexpr std::uint32_t kAccelerationSaturated = 1u << 1;
inline constexpr std::uint32_t kAngularRateSaturated = 1u << 2;
inline constexpr std::uint32_t kAdcOutOfSync = 1u << 3;
inline constexpr std::uint32_t kForceTorqueOutOfRange = 1u << 4;
inline constexpr std::uint32_t kOvertemperature = 1u << 5;
inline constexpr std::uint32_t kWrongSupplyVoltage = 1u << 6;

/// What the sensor's firmware sends acceleration and angular rate in.
enum class ImuUnits : std::uint8_t { g_dps, si };

using Vector3 = std::array<double, 3>;

/// One decoded sample in SI units and the sensor's own frame: `protocol.pdo.Sample` in C++, to the bit.
struct Sample {
    Vector3 force{};                      ///< N
    Vector3 torque{};                     ///< Nm
    Vector3 acceleration{};               ///< m/s^2
    Vector3 angular_rate{};               ///< rad/s
    double temperature = 0.0;             ///< degrees Celsius
    std::array<double, 4> orientation{};  ///< x, y, z, w, the sensor's own estimate, if `has_orientation`
    bool has_orientation = false;         ///< false: the sensor maps none, or all four are zero (no estimate)
    std::uint8_t status = 0;
    std::uint32_t warnings = 0;  ///< the warnings register
    std::uint16_t force_torque_saturated = 0;
    std::uint8_t acceleration_saturated = 0;
    std::uint8_t angular_rate_saturated = 0;

    /// Fx Fy Fz Mx My Mz Ax Ay Az Rx Ry Rz, as on `/sensone_sensor_data`.
    std::array<double, 12> array() const noexcept {
        return {force[0],        force[1],        force[2],        torque[0],       torque[1],       torque[2],
                acceleration[0], acceleration[1], acceleration[2], angular_rate[0], angular_rate[1], angular_rate[2]};
    }

    /// Whether every measured value is a finite number.
    bool is_finite() const noexcept {
        double total = temperature;  // a sum of float32 values cannot overflow a double
        for (const double value : array()) total += value;
        for (const double value : orientation) total += value;
        return std::isfinite(total);
    }
};

inline constexpr std::size_t kPdoSize = 61;                 // bytes of process data
inline constexpr std::size_t kPdoSizeWithOrientation = 77;  // the same, and an orientation quaternion

namespace detail {

template <typename Number>
constexpr Number big_endian(const std::uint8_t* bytes) noexcept {
    static_assert(sizeof(Number) > 1);
    Number value = 0;
    for (std::size_t i = 0; i < sizeof(Number); ++i) value = static_cast<Number>(value << 8 | bytes[i]);
    return value;
}

template <typename Number>
constexpr Number little_endian(const std::uint8_t* bytes) noexcept {
    static_assert(sizeof(Number) > 1);
    Number value = 0;
    for (std::size_t i = sizeof(Number); i-- > 0;) value = static_cast<Number>(value << 8 | bytes[i]);
    return value;
}

/// A REAL: IEEE 754, 4 bytes, little-endian.
inline double real(const std::uint8_t* bytes) noexcept {
    static_assert(sizeof(float) == 4 && std::numeric_limits<float>::is_iec559);
    const auto bits = little_endian<std::uint32_t>(bytes);
    float value = 0.0f;
    std::memcpy(&value, &bits, sizeof value);
    return static_cast<double>(value);
}

/// Offsets in the process data, docs/protocol.md; a test compares them with the table in protocol/pdo.py.
enum PdoOffset : std::size_t {
    kStatusAt = 0,
    kWarningsAt = 1,
    kForceAt = 5,
    kTorqueAt = 17,
    kForceTorqueSaturatedAt = 29,
    kAccelerationAt = 31,
    kAccelerationSaturatedAt = 43,
    kAngularRateAt = 44,
    kAngularRateSaturatedAt = 56,
    kTemperatureAt = 57,
    kOrientationAt = 61,
};

}  // namespace detail

/// Decode process data of 61 or 77 bytes; false, and `sample` as it was, if `size` is anything else.
inline bool decode(const std::uint8_t* data, std::size_t size, ImuUnits units, Sample& sample) noexcept {
    if (size != kPdoSize && size != kPdoSizeWithOrientation) return false;
    const double g = units == ImuUnits::si ? 1.0 : kStandardGravity;
    const double degree = units == ImuUnits::si ? 1.0 : kPi / 180.0;
    for (std::size_t axis = 0; axis < 3; ++axis) {
        sample.force[axis] = detail::real(data + detail::kForceAt + 4 * axis);
        sample.torque[axis] = detail::real(data + detail::kTorqueAt + 4 * axis);
        sample.acceleration[axis] = detail::real(data + detail::kAccelerationAt + 4 * axis) * g;
        sample.angular_rate[axis] = detail::real(data + detail::kAngularRateAt + 4 * axis) * degree;
    }
    sample.temperature = detail::real(data + detail::kTemperatureAt);
    sample.status = data[detail::kStatusAt];
    sample.warnings = detail::little_endian<std::uint32_t>(data + detail::kWarningsAt);
    sample.force_torque_saturated = detail::little_endian<std::uint16_t>(data + detail::kForceTorqueSaturatedAt);
    sample.acceleration_saturated = data[detail::kAccelerationSaturatedAt];
    sample.angular_rate_saturated = data[detail::kAngularRateSaturatedAt];
    sample.has_orientation = false;
    sample.orientation = {};
    if (size == kPdoSizeWithOrientation) {
        for (std::size_t i = 0; i < 4; ++i) {
            sample.orientation[i] = detail::real(data + detail::kOrientationAt + 4 * i);
            // NaN counts as an estimate, as in Python: it must not pass for "none".
            if (!(std::fpclassify(sample.orientation[i]) == FP_ZERO)) sample.has_orientation = true;
        }
        if (!sample.has_orientation) sample.orientation = {};
    }
    return true;
}

// ---------------------------------------------------------------------------------------------- framing

/// One DATA message; `process_data` points into the decoder and is valid until its next call.
struct Frame {
    std::uint64_t sequence = 0;      ///< counts this sensor's frames at the server
    std::uint64_t stamp_ns = 0;      ///< CLOCK_REALTIME of the sample
    std::uint64_t monotonic_ns = 0;  ///< CLOCK_MONOTONIC of the same moment, on the server's machine
    std::uint8_t sensor = 0;         ///< position on the bus
    std::uint8_t flags = 0;          ///< kRepeated, kInvalid, kGap
    std::uint16_t wkc = 0;           ///< working counter
    const std::uint8_t* process_data = nullptr;
    std::size_t size = 0;  ///< 61 or 77
};

/// Bytes of a framed connection in, messages out: `protocol.framing.FrameDecoder` in C++. Its memory is bounded and
/// comes from the constructor.
class FrameDecoder {
public:
    enum class Found : std::uint8_t {
        nothing,  ///< more bytes are needed
        data,     ///< `frame` is filled in
        json,     ///< `text` is the body of a JSON message; `json::is_object` says whether it can be used
        broken,   ///< this is not the protocol; nothing after it can be trusted, and `reason` says why
    };

    explicit FrameDecoder(std::size_t max_json_length = kMaxJsonLength)
        : max_json_length_(max_json_length), capacity_(max_json_length + kPrefix + kLeastRoom) {
        buffer_.reset(new (std::nothrow) std::uint8_t[capacity_]);
        if (buffer_)
            std::memset(buffer_.get(), 0, capacity_);  // every page is there before the first sample
        else
            capacity_ = 0;
    }

    /// Free space to receive into, and how much; none if there was no memory. Take all messages first.
    std::uint8_t* space(std::size_t& size) noexcept {
        if (start_ == end_) start_ = end_ = 0;
        if (capacity_ - end_ < kLeastRoom && start_ > 0) {
            std::memmove(buffer_.get(), buffer_.get() + start_, end_ - start_);
            end_ -= start_;
            start_ = 0;
        }
        size = capacity_ - end_;
        return buffer_.get() + end_;
    }

    /// `count` bytes were written to the beginning of `space`.
    void received(std::size_t count) noexcept {
        if (!reason_) end_ += count;
    }

    Found next(Frame& frame, std::string_view& text) noexcept {
        if (reason_) return Found::broken;
        const std::size_t available = end_ - start_;
        const std::uint8_t* const message = buffer_.get() + start_;
        if (available < kLengthSize) return Found::nothing;
        const std::size_t length = detail::big_endian<std::uint32_t>(message);
        const std::size_t longest = 1 + (max_json_length_ > kHeader + kPdoSizeWithOrientation
                                             ? max_json_length_ : kHeader + kPdoSizeWithOrientation);
        if (length < 1 || length > longest) return broken("a message of a length that no message has");
        if (available < kPrefix) return Found::nothing;
        const unsigned type = message[kLengthSize];
        if (type == kTypeData) {
            if (length != 1 + kHeader + kPdoSize && length != 1 + kHeader + kPdoSizeWithOrientation)
                return broken("a DATA message of a length that no sensor has");
        } else if (type != kTypeJson) {
            return broken("a message of an unknown type");
        } else if (length > max_json_length_ + 1) {
            return broken("a JSON message that is too long");
        }
        if (available < kLengthSize + length) return Found::nothing;
        start_ += kLengthSize + length;
        const std::uint8_t* const body = message + kPrefix;
        if (type == kTypeJson) {
            text = {reinterpret_cast<const char*>(body), length - 1};
            return Found::json;
        }
        frame.sequence = detail::big_endian<std::uint64_t>(body);
        frame.stamp_ns = detail::big_endian<std::uint64_t>(body + 8);
        frame.monotonic_ns = detail::big_endian<std::uint64_t>(body + 16);
        frame.sensor = body[24];
        frame.flags = body[25];
        frame.wkc = detail::big_endian<std::uint16_t>(body + 26);
        frame.process_data = body + kHeader;
        frame.size = length - 1 - kHeader;
        return Found::data;
    }

    /// Why it is broken; null if it is not.
    const char* reason() const noexcept { return reason_; }
    /// Bytes of an unfinished message that are waiting for the rest.
    std::size_t pending() const noexcept { return end_ - start_; }
    /// Whether it got its memory.
    bool usable() const noexcept { return buffer_ != nullptr; }

    /// As if new: for another connection.
    void reset() noexcept {
        start_ = end_ = 0;
        reason_ = nullptr;
    }

    static constexpr std::size_t kPrefix = 5;  // length and type

private:
    static constexpr std::size_t kLengthSize = 4;
    static constexpr std::size_t kHeader = 28;
    static constexpr std::size_t kLeastRoom = 65536;
    static constexpr unsigned kTypeData = 1, kTypeJson = 2;

    Found broken(const char* reason) noexcept {
        reason_ = reason;
        start_ = end_ = 0;
        return Found::broken;
    }

    std::size_t max_json_length_;
    std::size_t capacity_;
    std::unique_ptr<std::uint8_t[]> buffer_;
    std::size_t start_ = 0, end_ = 0;
    const char* reason_ = nullptr;
};

/// A JSON message for a framed connection.
inline std::string encode_json(std::string_view text) {
    const auto length = static_cast<std::uint32_t>(text.size() + 1);
    std::string message;
    for (int shift = 24; shift >= 0; shift -= 8) message.push_back(static_cast<char>(length >> shift & 0xFF));
    message.push_back('\x02');
    message.append(text);
    return message;
}

// ------------------------------------------------------------------------------------------------ accounting

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

// ------------------------------------------------------------------------------------------------------ JSON
//
// A reader for the server's replies and events: no tree, no allocation, no recursion. `is_object` checks a text whole,
// as strictly as protocol/text/json_text.py; after that a `Value` is a piece of it that is known to be well-formed.

namespace json {

namespace detail {

constexpr bool is_blank(char c) noexcept { return c == ' ' || c == '\t' || c == '\n' || c == '\r'; }
constexpr bool is_digit(char c) noexcept { return c >= '0' && c <= '9'; }
constexpr int hex_digit(char c) noexcept {
    return is_digit(c) ? c - '0' : c >= 'a' && c <= 'f' ? c - 'a' + 10 : c >= 'A' && c <= 'F' ? c - 'A' + 10 : -1;
}

/// Decode the strict UTF-8 sequence at `p` and move behind it; false if there is none (overlong, a surrogate, cut off).
inline bool take_utf8(const char*& p, const char* end, char32_t& c) noexcept {
    if (p == end) return false;
    const auto lead = static_cast<unsigned char>(*p);
    const int more = lead < 0x80 ? 0 : lead >> 5 == 6 ? 1 : lead >> 4 == 14 ? 2 : lead >> 3 == 30 ? 3 : -1;
    if (more < 0 || end - p <= more) return false;
    c = more == 0 ? lead : lead & (0x3Fu >> more);
    for (int i = 1; i <= more; ++i) {
        const auto next = static_cast<unsigned char>(p[i]);
        if (next >> 6 != 2) return false;
        c = c << 6 | (next & 0x3Fu);
    }
    constexpr char32_t kLeast[] = {0, 0x80, 0x800, 0x10000};
    if (c < kLeast[more] || c > 0x10FFFF || (c >= 0xD800 && c < 0xE000)) return false;
    p += more + 1;
    return true;
}

/// Moves over a text and checks it on the way. Every method moves behind what it names, or returns false.
class Scanner {
public:
    explicit Scanner(std::string_view text) noexcept : p_(text.data()), end_(text.data() + text.size()) {}

    const char* position() const noexcept { return p_; }
    bool at_end() noexcept { return blanks(), p_ == end_; }
    void blanks() noexcept {
        while (p_ != end_ && is_blank(*p_)) ++p_;
    }

    /// Blanks and this character.
    bool take(char c) noexcept { return !at_end() && *p_ == c && (++p_, true); }

    bool value() noexcept {
        std::array<char, kMaxJsonDepth> closing{};
        for (std::size_t depth = 0;;) {
            if (at_end()) return false;
            bool opened = *p_ == '{' || *p_ == '[';
            if (opened) {
                if (depth == kMaxJsonDepth) return false;
                closing[depth++] = *p_++ == '{' ? '}' : ']';
            } else if (!scalar()) {
                return false;
            }
            while (depth > 0 && take(closing[depth - 1])) --depth, opened = false;
            if (depth == 0) return true;
            if (!opened && !take(',')) return false;
            if (closing[depth - 1] == '}' && !(blanks(), string() && take(':'))) return false;
        }
    }

    bool string() noexcept {
        if (p_ == end_ || *p_++ != '"') return false;
        while (p_ != end_ && *p_ != '"') {
            char32_t c = 0;
            if (!(*p_ == '\\' ? escape() : take_utf8(p_, end_, c) && c >= 0x20)) return false;
        }
        return p_ != end_ && (++p_, true);
    }

private:
    bool scalar() noexcept {
        if (*p_ == '"') return string();
        return word("true") || word("false") || word("null") || number();
    }

    bool word(std::string_view expected) noexcept {
        if (std::string_view(p_, static_cast<std::size_t>(end_ - p_)).substr(0, expected.size()) != expected) return false;
        p_ += expected.size();
        return true;
    }

    bool escape() noexcept {
        if (++p_ == end_) return false;
        const char kind = *p_++;
        if (kind != 'u') return std::string_view("\"\\/bfnrt").find(kind) != std::string_view::npos;
        for (int i = 0; i < 4; ++i, ++p_)
            if (p_ == end_ || hex_digit(*p_) < 0) return false;
        return true;
    }

    std::size_t digits() noexcept {
        const char* const from = p_;
        while (p_ != end_ && is_digit(*p_)) ++p_;
        return static_cast<std::size_t>(p_ - from);
    }
    bool one_of(char a, char b) noexcept { return p_ != end_ && (*p_ == a || *p_ == b) && (++p_, true); }

    bool number() noexcept {
        const char* const from = p_;
        one_of('-', '-');
        const bool zero = p_ != end_ && *p_ == '0';
        const std::size_t whole = digits();
        if (whole == 0 || (zero && whole > 1)) return false;
        const bool fraction = one_of('.', '.');
        if (fraction && digits() == 0) return false;
        const bool exponent = one_of('e', 'E');
        const bool small = exponent ? one_of('-', '-') : zero;
        if (exponent && !small) one_of('+', '+');
        if (exponent && digits() == 0) return false;
        if (!fraction && !exponent) return whole <= kMaxJsonDigits;
        double value = 0.0;  // out of range is too large, as JSON for infinity, or next to nothing, which is fine
        return std::from_chars(from, p_, value).ec != std::errc::result_out_of_range || small;
    }

    const char* p_;
    const char* end_;
};

}  // namespace detail

/// Whether `text` is one JSON object in UTF-8 within the limits above.
inline bool is_object(std::string_view text) noexcept {
    detail::Scanner scanner(text);
    scanner.blanks();
    const char* const begin = scanner.position();
    return begin != text.data() + text.size() && *begin == '{' && scanner.value() && scanner.at_end();
}

/// The characters of a string, given what is between its quotes, one code point at a time.
class Characters {
public:
    explicit Characters(std::string_view inside) noexcept : p_(inside.data()), end_(p_ + inside.size()) {}

    /// The next code point; false at the end. A lone surrogate, which JSON can spell, comes as it is.
    bool next(char32_t& c) noexcept {
        if (p_ == end_ || *p_ != '\\') return detail::take_utf8(p_, end_, c);
        constexpr std::string_view kKinds = "bfnrt", kMeanings = "\b\f\n\r\t";
        const char kind = p_[1];
        p_ += 2;
        if (kind != 'u') {
            const std::size_t found = kKinds.find(kind);
            c = static_cast<unsigned char>(found == std::string_view::npos ? kind : kMeanings[found]);
            return true;
        }
        c = four_digits(p_);
        if (c >= 0xD800 && c < 0xDC00 && end_ - p_ >= 6 && p_[0] == '\\' && p_[1] == 'u') {
            const char* after = p_ + 2;
            const char32_t low = four_digits(after);
            if (low >= 0xDC00 && low < 0xE000) c = 0x10000 + ((c - 0xD800) << 10) + (low - 0xDC00), p_ = after;
        }
        return true;
    }

private:
    static char32_t four_digits(const char*& p) noexcept {
        char32_t value = 0;
        for (int i = 0; i < 4; ++i) value = value << 4 | static_cast<char32_t>(detail::hex_digit(*p++));
        return value;
    }

    const char* p_;
    const char* end_;
};

/// A piece of a text that `is_object` accepted, which must outlive it. Default: no value.
class Value {
public:
    Value() = default;
    /// `text` must be exactly one value of a checked text, or the whole of it.
    explicit Value(std::string_view text) noexcept : text_(text) {
        while (!text_.empty() && detail::is_blank(text_.front())) text_.remove_prefix(1);
        while (!text_.empty() && detail::is_blank(text_.back())) text_.remove_suffix(1);
    }

    std::string_view text() const noexcept { return text_; }
    explicit operator bool() const noexcept { return !text_.empty(); }
    bool is_object() const noexcept { return first() == '{'; }
    bool is_array() const noexcept { return first() == '['; }
    bool is_string() const noexcept { return first() == '"'; }
    bool is_number() const noexcept { return first() == '-' || detail::is_digit(first()); }

    bool get(bool& value) const noexcept {
        if (text_ != "true" && text_ != "false") return false;
        value = text_ == "true";
        return true;
    }

    /// A number as double, or a whole number that fits; anything else is false and leaves `value` as it was.
    template <typename Number, typename = std::enable_if_t<std::is_arithmetic_v<Number>>>
    bool get(Number& value) const noexcept {
        if (!is_number()) return false;
        Number found = 0;
        const char* const end = text_.data() + text_.size();
        const auto done = std::from_chars(text_.data(), end, found);
        // A double that is out of range and was accepted with a fraction or exponent is next to nothing.
        const bool tiny = std::is_floating_point_v<Number> && text_.find_first_of(".eE") != std::string_view::npos;
        if (done.ec != std::errc() && !tiny) return false;
        if (done.ptr != end) return false;
        value = done.ec == std::errc() ? found : Number{0};
        return true;
    }

    /// A string, cut off where it does not fit.
    template <std::size_t Size>
    bool get(Text<Size>& value) const noexcept {
        if (!is_string()) return false;
        value.clear();
        Characters characters(inside());
        for (char32_t c = 0; characters.next(c);) add(value, c >= 0xD800 && c < 0xE000 ? 0xFFFD : c);
        return true;
    }

    /// Whether it is this string, spelled without escapes, as the server spells names.
    bool is(std::string_view wanted) const noexcept { return is_string() && inside() == wanted; }

    /// The text between the quotes of a string.
    std::string_view inside() const noexcept { return is_string() ? text_.substr(1, text_.size() - 2) : std::string_view(); }

    /// The member of this name, the last one if there are several; no value if there is none.
    Value operator[](std::string_view name) const noexcept;

private:
    char first() const noexcept { return text_.empty() ? '\0' : text_.front(); }

    template <std::size_t Size>
    static void add(Text<Size>& text, char32_t c) noexcept {
        const std::size_t more = c < 0x80 ? 0 : c < 0x800 ? 1 : c < 0x10000 ? 2 : 3;
        constexpr char32_t kLead[] = {0, 0xC0, 0xE0, 0xF0};
        std::array<char, 4> bytes{static_cast<char>(kLead[more] | c >> (6 * more))};
        for (std::size_t i = 1; i <= more; ++i) bytes[i] = static_cast<char>(0x80 | (c >> (6 * (more - i)) & 0x3F));
        text.add({bytes.data(), more + 1});
    }

    std::string_view text_;
};

/// The members of an object or the items of an array, in order. None for any other value.
class Items {
public:
    explicit Items(Value of) noexcept : scanner_(inside(of)), in_object_(of.is_object()) {}

    bool next(Value& value) noexcept {
        Value name;
        return next(name, value);
    }

    /// `name` is the member's name, a string; no value for an array.
    bool next(Value& name, Value& value) noexcept {
        if (scanner_.at_end()) return false;
        const char* from = scanner_.position();
        if (in_object_) {
            (void)scanner_.string();
            name = piece(from);
            (void)scanner_.take(':');
            scanner_.blanks();
            from = scanner_.position();
        }
        (void)scanner_.value();
        value = piece(from);
        (void)scanner_.take(',');
        return true;
    }

private:
    static std::string_view inside(Value of) noexcept {
        return of.is_object() || of.is_array() ? of.text().substr(1, of.text().size() - 2) : std::string_view();
    }
    Value piece(const char* from) const noexcept {
        return Value(std::string_view(from, static_cast<std::size_t>(scanner_.position() - from)));
    }

    detail::Scanner scanner_;
    bool in_object_;
};

inline Value Value::operator[](std::string_view name) const noexcept {
    Value found, key, value;
    if (!is_object()) return found;
    for (Items items(*this); items.next(key, value);)
        if (key.is(name)) found = value;
    return found;
}

}  // namespace json

// --------------------------------------------------------------------------------------------- descriptions

/// A sensor as the server describes it.
struct SensorInfo {
    std::uint8_t sensor = 0;  ///< position on the bus
    std::uint64_t serial = 0;
    std::uint32_t pdo_size = 0;  ///< bytes of process data
    double rate_hz = 0.0;
    Text<32> name, hardware, firmware, state;
};

/// What `describe` and `subscribe` answer.
struct Description {
    Text<32> version;               ///< the server's
    std::size_t sensor_count = 0;   ///< of these in `sensors`
    std::array<SensorInfo, kMaxSensors> sensors;
};

namespace detail {

/// False if this is no description, or one of another protocol version.
inline bool read(json::Value reply, Description& into) noexcept {
    int protocol = 0;
    if (!reply["protocol"].get(protocol) || protocol != kProtocolVersion || !reply["sensors"].is_array()) return false;
    into = Description();
    reply["version"].get(into.version);
    json::Value each;
    for (json::Items items(reply["sensors"]); into.sensor_count < kMaxSensors && items.next(each);) {
        SensorInfo& info = into.sensors[into.sensor_count++];
        each["sensor"].get(info.sensor);
        each["serial"].get(info.serial);
        each["pdo_size"].get(info.pdo_size);
        each["rate_hz"].get(info.rate_hz);
        each["name"].get(info.name);
        each["hardware"].get(info.hardware);
        each["firmware"].get(info.firmware);
        each["state"].get(info.state);
    }
    return true;
}

}  // namespace detail

// --------------------------------------------------------------------------------------------------- sockets

namespace detail {

using Message = Text<320>;

/// What a failed connection comes to, in words. Not strerror: that may allocate.
inline void describe_errno(Message& text, int number) noexcept {
    switch (number) {
        case ECONNREFUSED: text.add("nobody listens there: start ethercat-server, or name its port"); break;
        case ECONNRESET: case EPIPE: text.add("the server reset the connection"); break;
        case ETIMEDOUT: text.add("no answer"); break;
        case EHOSTUNREACH: case ENETUNREACH: text.add("no route to that host"); break;
        case EMFILE: case ENFILE: text.add("too many open files"); break;
        default: text.add("error ").add(std::int64_t{number});
    }
}

/// Where a server may be: the addresses of a host name, asked for once.
struct Addresses {
    std::array<sockaddr_storage, 8> address{};
    std::array<socklen_t, 8> length{};
    std::size_t count = 0;

    /// May wait for name servers.
    bool resolve(const std::string& host, std::uint16_t port, Message& error) noexcept {
        addrinfo wanted{}, *found = nullptr;
        wanted.ai_socktype = SOCK_STREAM;
        Text<8> service;
        service.add(std::int64_t{port});
        const int result = getaddrinfo(host.c_str(), service.c_str(), &wanted, &found);
        count = 0;
        if (result != 0) {
            error.clear();
            error.add("no address for ").add(host).add(": ").add(gai_strerror(result));
            return false;
        }
        for (const addrinfo* each = found; each && count < address.size(); each = each->ai_next) {
            if (each->ai_addrlen > sizeof(sockaddr_storage)) continue;
            std::memcpy(&address[count], each->ai_addr, each->ai_addrlen);
            length[count++] = each->ai_addrlen;
        }
        freeaddrinfo(found);
        return count > 0;
    }
};

/// A non-blocking TCP socket; closes itself.
class Socket {
public:
    Socket() = default;
    Socket(const Socket&) = delete;
    Socket& operator=(const Socket&) = delete;
    ~Socket() { close(); }

    int fd() const noexcept { return fd_; }
    bool open() const noexcept { return fd_ >= 0; }
    void close() noexcept {
        if (fd_ >= 0) ::close(fd_);
        fd_ = -1;
    }

    /// Begin to connect; 0 or the errno. `connected` tells when it is done.
    int begin(const sockaddr_storage& address, socklen_t length, int receive_buffer) noexcept {
        close();
        fd_ = ::socket(address.ss_family, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
        if (fd_ < 0) return errno;
        set(IPPROTO_TCP, TCP_NODELAY, 1);
        // A host that is gone without a word is noticed within some 5 s. A stopped server is not gone.
        set(SOL_SOCKET, SO_KEEPALIVE, 1);
        set(IPPROTO_TCP, TCP_KEEPIDLE, 2);
        set(IPPROTO_TCP, TCP_KEEPINTVL, 1);
        set(IPPROTO_TCP, TCP_KEEPCNT, 3);
        // With less TCP needs hundreds of milliseconds to get going again after a stall.
        if (receive_buffer > 0) set(SOL_SOCKET, SO_RCVBUF, receive_buffer < 16384 ? 16384 : receive_buffer);
        if (::connect(fd_, reinterpret_cast<const sockaddr*>(&address), length) == 0 || errno == EINPROGRESS) return 0;
        const int error = errno;
        close();
        return error;
    }

    /// Whether the connection is there; `error` is its errno if it failed.
    bool connected(int& error) noexcept {
        error = 0;
        pollfd one{fd_, POLLOUT, 0};
        if (::poll(&one, 1, 0) <= 0) return false;
        socklen_t size = sizeof error;
        if (getsockopt(fd_, SOL_SOCKET, SO_ERROR, &error, &size) != 0) error = errno;
        return error == 0;
    }

    /// Send all of a short message at once; false if that is not possible. A fresh connection has room for it.
    bool send(std::string_view message) noexcept {
        return ::send(fd_, message.data(), message.size(), MSG_NOSIGNAL) == static_cast<ssize_t>(message.size());
    }

    /// Bytes received; 0: there are none now; -1: the connection is over, `error` is its errno, 0 = closed.
    ssize_t receive(std::uint8_t* into, std::size_t size, int& error) noexcept {
        const ssize_t count = ::recv(fd_, into, size, MSG_DONTWAIT);
        if (count > 0) return count;
        error = count == 0 ? 0 : errno;
        return count < 0 && (error == EAGAIN || error == EWOULDBLOCK || error == EINTR) ? 0 : -1;
    }

    /// Whether the other end is on this machine, so that its CLOCK_MONOTONIC is ours.
    bool same_machine() const noexcept {
        sockaddr_storage here{}, there{};
        socklen_t here_size = sizeof here, there_size = sizeof there;
        if (getsockname(fd_, reinterpret_cast<sockaddr*>(&here), &here_size) != 0 ||
            getpeername(fd_, reinterpret_cast<sockaddr*>(&there), &there_size) != 0 || here.ss_family != there.ss_family)
            return false;
        if (there.ss_family == AF_INET) {
            sockaddr_in mine{}, others{};
            std::memcpy(&mine, &here, sizeof mine);
            std::memcpy(&others, &there, sizeof others);
            return mine.sin_addr.s_addr == others.sin_addr.s_addr || ntohl(others.sin_addr.s_addr) >> 24 == 127;
        }
        if (there.ss_family == AF_INET6) {
            sockaddr_in6 mine{}, others{};
            std::memcpy(&mine, &here, sizeof mine);
            std::memcpy(&others, &there, sizeof others);
            return std::memcmp(&mine.sin6_addr, &others.sin6_addr, sizeof mine.sin6_addr) == 0;
        }
        return false;
    }

    /// Wait until there is something to do, at most until CLOCK_MONOTONIC is `until_ns`; false if a signal came.
    bool wait(bool to_write, std::int64_t until_ns) const noexcept {
        const std::int64_t left = until_ns - monotonic_now_ns();
        if (left <= 0) return true;
        const timespec timeout{static_cast<time_t>(left / 1'000'000'000), static_cast<long>(left % 1'000'000'000)};
        pollfd one{fd_, static_cast<short>(to_write ? POLLOUT : POLLIN), 0};
        return ::ppoll(&one, open() ? 1 : 0, &timeout, nullptr) >= 0 || errno != EINTR;
    }

private:
    void set(int level, int name, int value) noexcept { setsockopt(fd_, level, name, &value, sizeof value); }

    int fd_ = -1;
};

/// `now` plus a duration, without overflow: a very long one is "never".
inline std::int64_t after(std::int64_t now_ns, nanoseconds duration) noexcept {
    constexpr std::int64_t never = std::numeric_limits<std::int64_t>::max();
    const std::int64_t more = duration.count() < 0 ? 0 : duration.count();
    return more > never - now_ns ? never : now_ns + more;
}

}  // namespace detail

// ------------------------------------------------------------------------------------------------ the stream

/// Whether the newest sample may be used, and if not, why there is no newer one.
enum class Condition : std::uint8_t {
    fresh,         ///< there is a sample, and it is no older than `Options::max_age`
    late,          ///< samples arrive, but older than that: a backlog, or a machine that is too slow
    repeated,      ///< the sensor gives the same process data again and again
    invalid,       ///< the working counter is short: the sensor does not answer on the bus
    sensor_lost,   ///< the server says that the sensor is lost
    silent,        ///< connected, but nothing of this sensor arrives: the server is stopped or stuck
    disconnected,  ///< no connection; `Client::error` says why
    bad_clock,     ///< stamps ahead of this machine's clock: an age cannot be known
};

inline const char* to_string(Condition condition) noexcept {
    switch (condition) {
        case Condition::fresh: return "fresh";
        case Condition::late: return "late: what arrives is too old";
        case Condition::repeated: return "repeated: the sensor gives nothing new";
        case Condition::invalid: return "invalid: the sensor does not answer on the bus";
        case Condition::sensor_lost: return "lost: the server says that the sensor is lost";
        case Condition::silent: return "silent: nothing arrives from the server";
        case Condition::disconnected: return "disconnected";
        case Condition::bad_clock: return "bad clock: the server's stamps are ahead of this machine's";
    }
    return "?";
}

/// What the age of a sample is counted from.
enum class AgeFrom : std::uint8_t {
    automatic,  ///< the sample's instant if the server is on this machine, its arrival if not
    instant,    ///< `monotonic_ns`: server and client must share CLOCK_MONOTONIC
    arrival,    ///< the moment it was read from the socket: a lower bound of the age
};

struct Options {
    std::string host = "localhost";
    std::uint16_t port = 12001;
    std::vector<std::uint8_t> sensors{};  ///< positions on the bus; empty = all
    std::uint32_t every = 1;              ///< one frame in so many
    bool fresh_only = true;               ///< REPEATED frames only every 10 ms, to show that the sensor is silent
    ImuUnits imu_units = ImuUnits::g_dps;
    nanoseconds max_age = std::chrono::milliseconds(10);  ///< up to this a sample is `Condition::fresh`
    bool reconnect = true;                                ///< by itself, in steps taken by `latest` and `next`
    nanoseconds reconnect_every = std::chrono::milliseconds(100);
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

    /// The one thing to ask before a sample is used to control something.
    bool fresh() const noexcept { return condition == Condition::fresh; }
};

/// Counts of one sensor since the client was made.
struct Counters : StreamCounts {
    std::uint64_t passed_over = 0;  ///< samples that `latest` left out for a newer one
};

/// A subscription to the samples of one server. See the top of this file for units, threads and real time.
///
/// Reconnecting: if the connection is lost, the calls below report `Condition::disconnected` (or `fresh` for as long
/// as the last sample is younger than `max_age`), keep the last sample, whose age grows, and go on trying. Host names
/// are asked for in `connect` only. After a new connection the first sample has `gap`, and `connection` is one more.
class Client {
public:
    enum class Link : std::uint8_t { down, connecting, subscribing, up };

    /// Allocates everything that is ever needed.
    explicit Client(Options options = {})
        : options_(std::move(options)), sensors_(new (std::nothrow) SensorState[kPlaces]()) {
        std::string text = "{\"action\":\"subscribe\",\"every\":" + std::to_string(options_.every) +
                           ",\"fresh_only\":" + (options_.fresh_only ? "true" : "false");
        for (std::size_t i = 0; i < options_.sensors.size(); ++i)
            text += (i == 0 ? ",\"sensors\":[" : ",") + std::to_string(options_.sensors[i]);
        subscribe_ = encode_json(text + (options_.sensors.empty() ? "}" : "]}"));
        error_.add("not connected yet: call connect()");
    }
    Client(std::string host, std::uint16_t port) : Client(options_for(std::move(host), port)) {}
    Client(const Client&) = delete;
    Client& operator=(const Client&) = delete;

    /// Connect and subscribe; waits. False if it did not succeed within `timeout` or was refused: `error` says why,
    /// and unless `reconnect` is off, `latest` and `next` go on trying.
    bool connect(nanoseconds timeout = std::chrono::seconds(2)) noexcept {
        const std::int64_t deadline = detail::after(monotonic_now_ns(), timeout);
        if (!decoder_.usable() || !sensors_) return fail_now("not enough memory");
        socket_.close();
        link_ = Link::down;
        addresses_.count = 0;
        if (!addresses_.resolve(options_.host, options_.port, error_)) return false;
        for (std::size_t tries = 0;;) {
            const std::int64_t now = monotonic_now_ns();
            if (link_ == Link::down && (refused_ || tries++ == addresses_.count)) break;
            if (now >= deadline) {
                lose("the server did not answer in time");
                break;
            }
            refused_ = false;
            if (link_ == Link::down) begin(now);
            if (link_ == Link::connecting) finish_connecting(now);
            if (link_ == Link::subscribing) await_reply();
            if (link_ == Link::up) return true;
            const std::int64_t until = deadline < attempt_ends_ns_ ? deadline : attempt_ends_ns_;
            if (link_ != Link::down) (void)socket_.wait(link_ == Link::connecting, until);
        }
        refused_ = false;
        return false;
    }

    /// End the connection; nothing is tried again until `connect`.
    void close() noexcept {
        lose("closed by this program");
        addresses_.count = 0;
    }

    /// Read what has arrived, without waiting. Returns how many DATA messages that were.
    std::size_t update() noexcept {
        now_ns_ = monotonic_now_ns();
        more_waits_ = false;
        if (link_ < Link::subscribing && !step()) return 0;
        std::size_t frames = 0, budget = options_.max_bytes_per_call;
        bool may_be_more = true;
        for (int reads = 0;; ++reads) {
            frames += take_messages();
            if (!socket_.open() || !may_be_more) break;
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
    /// says why. Returns early when the connection is lost and when a signal handler ran.
    Reading next(nanoseconds timeout) noexcept;

    /// Why there is no connection, or what the server last complained of. A sentence, for a person.
    const char* error() const noexcept { return error_.c_str(); }
    Link link() const noexcept { return link_; }
    bool connected() const noexcept { return link_ == Link::up; }
    /// The server's sensors, as it described them when the subscription was made.
    const Description& description() const noexcept { return description_; }
    Counters counters(std::uint8_t place = 0) const noexcept {
        if (!sensors_) return {};
        return {sensors_[place].accounting.counts, sensors_[place].all_passed_over};
    }
    /// Connections made so far.
    std::uint32_t connections() const noexcept { return connections_; }
    /// How often a sensor was reconfigured while connected: ranges, filters or rate may be others now.
    std::uint32_t reconfigurations() const noexcept { return reconfigurations_; }
    /// JSON messages that could not be understood; they were left out.
    std::uint64_t bad_messages() const noexcept { return bad_messages_; }
    /// For poll or epoll with other things; another one after a new connection, -1 without one.
    int fd() const noexcept { return socket_.fd(); }

private:
    static constexpr std::size_t kPlaces = 256;  // every value of the `sensor` byte
    static constexpr double kHighestRateHz = 1e6;
    static constexpr int kMostReads = 16;                // in one call of `update`
    static constexpr ssize_t kBacklog = 2048;            // received at once: more than any steady stream
    static constexpr std::int64_t kAttemptNs = 2'000'000'000;
    static constexpr std::int64_t kClockToleranceNs = 1'000'000;
    static constexpr std::int64_t kLeastSilenceNs = 30'000'000;  // three times the pace of REPEATED frames

    struct SensorState {
        Frame newest;   // of any kind; no process data
        Frame sampled;  // the newest that brought a sample
        std::array<std::uint8_t, kPdoSizeWithOrientation> process_data{};
        std::int64_t newest_received_ns = 0, sampled_received_ns = 0;
        bool seen = false;  // any frame, on any connection
        bool has_sample = false, unread = false, gap = false, lost = false;
        std::uint64_t passed_over = 0, all_passed_over = 0;
        std::uint32_t warnings = 0;
        StreamAccounting accounting;
        StreamCounts read;  // when the last reading was taken
    };

    static Options options_for(std::string host, std::uint16_t port) {
        Options options;
        options.host = std::move(host);
        options.port = port;
        return options;
    }

    // -- the connection

    bool fail_now(const char* why) noexcept {
        error_.clear();
        error_.add(why);
        return false;
    }

    void describe_target() noexcept {
        error_.clear();
        error_.add(options_.host).add(" port ").add(std::int64_t{options_.port}).add(": ");
    }

    /// The connection is over; `why` is a part of a sentence.
    void lose(const char* why) noexcept {
        describe_target();
        error_.add(why);
        drop();
    }
    void lose(int error_number) noexcept {
        describe_target();
        if (error_number == 0)
            error_.add(shutting_down_ ? "the server was shut down" : "the server closed the connection");
        else
            detail::describe_errno(error_, error_number);
        drop();
    }
    void drop() noexcept {
        socket_.close();
        decoder_.reset();
        link_ = Link::down;
        shutting_down_ = false;
    }

    /// A non-blocking step towards a connection; true if there may be something to read.
    bool step() noexcept {
        if (link_ == Link::down) {
            if (!options_.reconnect || now_ns_ < retry_at_ns_) return false;
            begin(now_ns_);
        }
        if (link_ == Link::connecting) finish_connecting(now_ns_);
        return link_ == Link::subscribing;
    }

    void begin(std::int64_t now_ns) noexcept {
        if (addresses_.count == 0 || !decoder_.usable() || !sensors_) return;
        const std::size_t which = next_address_++ % addresses_.count;
        attempt_ends_ns_ = now_ns + kAttemptNs;
        retry_at_ns_ = detail::after(now_ns, options_.reconnect_every);
        const int failed = socket_.begin(addresses_.address[which], addresses_.length[which], options_.receive_buffer);
        if (failed != 0)
            lose(failed);
        else
            link_ = Link::connecting;
    }

    void finish_connecting(std::int64_t now_ns) noexcept {
        int failed = 0;
        if (!socket_.connected(failed)) {
            if (failed != 0)
                lose(failed);
            else if (now_ns >= attempt_ends_ns_)
                lose(ETIMEDOUT);
            return;
        }
        if (!socket_.send(subscribe_)) return lose("the request to subscribe could not be sent");
        same_clock_ = options_.age_from == AgeFrom::instant ||
                      (options_.age_from == AgeFrom::automatic && socket_.same_machine());
        link_ = Link::subscribing;
    }

    /// Read as far as the reply, and no sample behind it: the first is for `next`.
    void await_reply() noexcept {
        Frame frame;
        std::size_t budget = options_.max_bytes_per_call;
        do {
            while (link_ == Link::subscribing && take_message(frame)) {
            }
        } while (link_ == Link::subscribing && receive(budget) > 0 && budget > 0);
    }

    // -- what arrives

    /// Receive once, at most `budget` bytes, which become less. The number, 0 for nothing now, -1 if that was the end.
    ssize_t receive(std::size_t& budget) noexcept {
        std::size_t room = 0;
        std::uint8_t* const into = decoder_.space(room);
        if (room > budget) room = budget;
        int failed = 0;
        const ssize_t count = socket_.receive(into, room, failed);
        now_ns_ = monotonic_now_ns();
        if (count < 0) {
            lose(failed);
        } else if (count > 0) {
            decoder_.received(static_cast<std::size_t>(count));
            budget -= static_cast<std::size_t>(count);
            received_ns_ = now_ns_;
        } else if (link_ == Link::subscribing && now_ns_ >= attempt_ends_ns_) {
            lose("the server did not answer the request to subscribe");
        }
        return count;
    }

    std::size_t take_messages() noexcept {
        Frame frame;
        std::size_t frames = 0;
        while (socket_.open() && take_message(frame))
            if (frame.process_data) ++frames;
        return frames;
    }

    /// Take one message; false if there is no whole one. `frame.process_data` is null if it was no DATA.
    bool take_message(Frame& frame) noexcept {
        std::string_view text;
        frame.process_data = nullptr;
        switch (decoder_.next(frame, text)) {
            case FrameDecoder::Found::data: take(frame); return true;
            case FrameDecoder::Found::json: take(text); return true;
            case FrameDecoder::Found::broken: {
                const char* const reason = decoder_.reason();
                describe_target();
                error_.add("the server sent ").add(reason).add(": is that ethercat-server?");
                drop();
                return false;
            }
            case FrameDecoder::Found::nothing: break;
        }
        return false;
    }

    void take(const Frame& frame) noexcept {
        SensorState& state = sensors_[frame.sensor];
        StreamAccounting& accounting = state.accounting;
        const bool reconnected = state.seen && !accounting.begun();  // nobody knows what was lost meanwhile
        const std::uint64_t restarts = accounting.counts.restarts;
        const FrameKind kind = accounting.take(frame.sequence, frame.monotonic_ns, frame.flags);
        if (kind == FrameKind::old) return;
        if (reconnected || accounting.counts.restarts > restarts || (frame.flags & kGap) != 0) state.gap = true;
        state.newest = frame;
        state.newest.process_data = nullptr;
        state.newest_received_ns = received_ns_;
        state.seen = true;
        if (kind != FrameKind::sample) return;
        if (state.unread) {
            ++state.passed_over;
            ++state.all_passed_over;
        }
        state.sampled = state.newest;
        std::memcpy(state.process_data.data(), frame.process_data, frame.size);
        state.sampled_received_ns = received_ns_;
        state.warnings |= detail::little_endian<std::uint32_t>(frame.process_data + detail::kWarningsAt);
        state.has_sample = state.unread = true;
        state.lost = false;
    }

    void take(std::string_view text) noexcept {
        if (!json::is_object(text)) {
            ++bad_messages_;
            return;
        }
        const json::Value message(text);
        if (const json::Value event = message["event"]) {
            std::uint8_t place = 0;
            const bool of_a_sensor = message["sensor"].get(place);
            if (event.is("sensor_lost") && of_a_sensor) {
                sensors_[place].lost = true;
                take_text(message["message"]);
            } else if (event.is("sensor_back") && of_a_sensor) {
                sensors_[place].lost = false;
            } else if (event.is("reconfigured")) {
                ++reconfigurations_;
                if (of_a_sensor) sensors_[place].accounting.rate_hz = 0.0;  // it may be another one now
            } else if (event.is("shutting_down")) {
                shutting_down_ = true;
            }
            return;
        }
        bool ok = false;
        if (!message["reply"] || !message["ok"].get(ok)) {
            ++bad_messages_;
        } else if (!ok) {
            describe_target();
            error_.add("the server refused: ");
            detail::Message reason;
            message["error"]["message"].get(reason);
            error_.add(reason.view());
            if (link_ == Link::subscribing) {
                refused_ = true;
                drop();
            }
        } else if (link_ == Link::subscribing && message["reply"].is("subscribe")) {
            if (!detail::read(message, description_)) {
                refused_ = true;
                return lose("the server speaks another version of the protocol");
            }
            link_ = Link::up;
            error_.clear();
            ++connections_;
            for (std::size_t i = 0; i < kPlaces; ++i) {
                sensors_[i].accounting.begin();
                sensors_[i].accounting.configure(options_.every, options_.fresh_only);
                sensors_[i].accounting.rate_hz = 0.0;
                sensors_[i].lost = false;
            }
            for (std::size_t i = 0; i < description_.sensor_count; ++i) {
                const double rate_hz = description_.sensors[i].rate_hz;
                if (rate_hz > 0.0 && rate_hz <= kHighestRateHz)
                    sensors_[description_.sensors[i].sensor].accounting.rate_hz = rate_hz;
            }
        }
    }

    void take_text(json::Value value) noexcept {
        error_.clear();
        value.get(error_);
    }

    // -- readings

    Reading read(std::uint8_t place) noexcept {
        Reading reading;
        reading.sensor = place;
        reading.connection = connections_;
        reading.more_waits = more_waits_;
        reading.condition = Condition::disconnected;
        if (!sensors_) return reading;
        SensorState& state = sensors_[place];
        reading.flags = state.newest.flags;
        reading.wkc = state.newest.wkc;
        reading.has_sample = state.has_sample;
        reading.is_new = state.unread;
        reading.gap = state.gap;
        const StreamCounts& counts = state.accounting.counts;
        reading.withheld = counts.withheld - state.read.withheld;
        reading.lost = counts.lost - state.read.lost;
        state.read = counts;
        reading.passed_over = state.passed_over;
        reading.warnings_seen = state.warnings;
        state.unread = state.gap = false;
        state.passed_over = 0;
        state.warnings = 0;
        bool ahead = false;
        if (state.has_sample) {
            reading.sequence = state.sampled.sequence;
            reading.stamp_ns = state.sampled.stamp_ns;
            reading.monotonic_ns = state.sampled.monotonic_ns;
            reading.received_ns = state.sampled_received_ns;
            (void)decode(state.process_data.data(), state.sampled.size, options_.imu_units, reading.sample);
            reading.age_is_lower_bound = !same_clock_;
            const auto from = same_clock_ ? state.sampled.monotonic_ns : static_cast<std::uint64_t>(state.sampled_received_ns);
            const auto now = static_cast<std::uint64_t>(now_ns_);
            ahead = from > now && from - now > static_cast<std::uint64_t>(kClockToleranceNs);
            if (!ahead) reading.age_ns = from < now ? static_cast<std::int64_t>(now - from) : 0;
        }
        reading.condition = condition(state, reading.age_ns, ahead);
        return reading;
    }

    Condition condition(const SensorState& state, std::int64_t age_ns, bool ahead) const noexcept {
        const std::int64_t max_age = options_.max_age.count();
        if (state.has_sample && !ahead && age_ns <= max_age) return Condition::fresh;
        if (link_ != Link::up) return Condition::disconnected;
        if (state.lost) return Condition::sensor_lost;
        const std::int64_t twice = detail::after(max_age, options_.max_age);
        const std::int64_t silence = twice > kLeastSilenceNs ? twice : kLeastSilenceNs;
        if (!state.accounting.begun() || now_ns_ - state.newest_received_ns > silence) return Condition::silent;
        if ((state.newest.flags & kInvalid) != 0) return Condition::invalid;
        if ((state.newest.flags & kRepeated) != 0) return Condition::repeated;
        return ahead ? Condition::bad_clock : Condition::late;
    }

    Options options_;
    std::unique_ptr<SensorState[]> sensors_;
    FrameDecoder decoder_;
    detail::Socket socket_;
    detail::Addresses addresses_;
    std::string subscribe_;
    detail::Message error_;
    Description description_;
    Link link_ = Link::down;
    std::size_t next_address_ = 0;
    std::int64_t now_ns_ = 0, received_ns_ = 0, attempt_ends_ns_ = 0, retry_at_ns_ = 0;
    std::uint32_t connections_ = 0, reconfigurations_ = 0;
    std::uint64_t bad_messages_ = 0;
    bool same_clock_ = false, more_waits_ = false;
    bool refused_ = false, shutting_down_ = false;
};

inline Reading Client::next(nanoseconds timeout) noexcept {
    const std::uint8_t first = options_.sensors.empty() ? std::uint8_t{0} : options_.sensors.front();
    now_ns_ = monotonic_now_ns();
    more_waits_ = false;
    const std::int64_t deadline = detail::after(now_ns_, timeout);
    for (bool has_read = false;;) {
        const bool was_open = socket_.open();
        if (link_ < Link::subscribing) (void)step();
        Frame frame;
        while (socket_.open() && take_message(frame)) {
            if (frame.process_data && (frame.flags & (kRepeated | kInvalid)) == 0) return read(frame.sensor);
        }
        // A server that sends without end what is no sample does not hold this up.
        if (has_read && now_ns_ >= deadline) break;
        if (link_ >= Link::subscribing) {
            std::size_t budget = options_.max_bytes_per_call;
            has_read = true;
            if (receive(budget) > 0) continue;
        } else {
            now_ns_ = monotonic_now_ns();
        }
        if (now_ns_ >= deadline || (was_open && !socket_.open())) break;
        std::int64_t until = deadline;
        if (link_ == Link::down && options_.reconnect && addresses_.count > 0 && retry_at_ns_ < until) until = retry_at_ns_;
        if ((link_ == Link::connecting || link_ == Link::subscribing) && attempt_ends_ns_ < until) until = attempt_ends_ns_;
        if (!socket_.wait(link_ == Link::connecting, until)) break;
        now_ns_ = monotonic_now_ns();
    }
    return read(first);
}

// ------------------------------------------------------------------------------------- control: one request each

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
        return detail::read(reply(), into) || fail("the server speaks another version of the protocol");
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

#endif  // BOTA_ETHERCAT_HPP
