// SPDX-License-Identifier: Apache-2.0
// Version 1 of the protocol (docs/protocol.md): a sensor's process data as `Sample`, the framing, a server's description.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <limits>
#include <optional>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "bota_ethercat/text.hpp"

namespace bota_ethercat {

inline constexpr int kProtocolVersion = 1;
inline constexpr std::size_t kMaxJsonLength = 65536;  // bytes of one JSON message, as bota_ethercat/framing.py
inline constexpr std::size_t kMaxSensors = 16;        // of which a description is kept
inline constexpr double kStandardGravity = 9.80665;  // m/s^2 in one g
inline constexpr double kPi = 3.14159265358979323846;

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

namespace detail {

/// The bits of a number. volatile, or else compilers may conclude from them what -ffast-math claims of the number.
inline std::uint64_t bits_of(double value) noexcept {
    std::uint64_t bits = 0;
    std::memcpy(&bits, &value, sizeof bits);
    const volatile std::uint64_t as_they_are = bits;
    return as_they_are;
}

inline constexpr std::uint64_t infinity_bits = 0x7FFull << 52;

}  // namespace detail

/// Neither NaN nor infinite, and NaN: also in a program of -ffast-math, where std::isfinite is always true.
inline bool is_finite(double value) noexcept { return (detail::bits_of(value) & detail::infinity_bits) != detail::infinity_bits; }
inline bool is_nan(double value) noexcept { return detail::bits_of(value) << 1 > detail::infinity_bits << 1; }

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
    bool is_finite() const noexcept { return wrench_is_finite() && imu_is_finite() && bota_ethercat::is_finite(temperature); }

    bool wrench_is_finite() const noexcept { return are_finite(force) && are_finite(torque); }
    /// Acceleration, angular rate and orientation.
    bool imu_is_finite() const noexcept {
        return are_finite(acceleration) && are_finite(angular_rate) && are_finite(orientation);
    }

    /// Whether force or torque went beyond what the sensor can measure.
    bool wrench_is_saturated() const noexcept {
        return (warnings & (kForceTorqueSaturated | kForceTorqueOutOfRange)) != 0 || force_torque_saturated != 0;
    }
    /// Whether the sensor says that its values mean nothing: the ADC of force and torque is out of sync, or the supply is wrong.
    bool wrench_is_faulty() const noexcept { return (warnings & (kAdcOutOfSync | kWrongSupplyVoltage)) != 0; }
    bool imu_is_faulty() const noexcept { return (warnings & kWrongSupplyVoltage) != 0; }
    /// Whether acceleration or angular rate went beyond the range that is set.
    bool imu_is_saturated() const noexcept {
        return (warnings & (kAccelerationSaturated | kAngularRateSaturated)) != 0 || acceleration_saturated != 0 ||
               angular_rate_saturated != 0;
    }

private:
    template <std::size_t Size>
    static bool are_finite(const std::array<double, Size>& values) noexcept {
        return std::all_of(values.begin(), values.end(), [](double value) { return bota_ethercat::is_finite(value); });
    }
};

inline constexpr std::size_t kPdoSize = 61;                 // bytes of process data
inline constexpr std::size_t kPdoSizeWithOrientation = 77;  // the same, and an orientation quaternion

namespace detail {

template <typename Number>
constexpr Number big_endian(const std::uint8_t* bytes) noexcept {
    Number value = 0;
    for (std::size_t i = 0; i < sizeof(Number); ++i) value = static_cast<Number>(value << 8 | bytes[i]);
    return value;
}

template <typename Number>
constexpr Number little_endian(const std::uint8_t* bytes) noexcept {
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

/// Offsets in the process data, docs/protocol.md; a test compares them with the table in bota_ethercat/pdo.py.
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
            if (detail::bits_of(sample.orientation[i]) << 1 != 0) sample.has_orientation = true;
        }
        if (!sample.has_orientation) sample.orientation = {};
    }
    return true;
}

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
        : max_json_length_(max_json_length), buffer_(max_json_length + kPrefix + kMinRoom) {}

    /// Free space to receive into, and how much. Take all messages first.
    std::uint8_t* space(std::size_t& size) noexcept {
        if (start_ == end_) start_ = end_ = 0;
        if (buffer_.size() - end_ < kMinRoom && start_ > 0) {
            std::memmove(buffer_.data(), buffer_.data() + start_, end_ - start_);
            end_ -= start_;
            start_ = 0;
        }
        size = buffer_.size() - end_;
        return buffer_.data() + end_;
    }

    /// `count` bytes were written to the beginning of `space`.
    void received(std::size_t count) noexcept {
        if (!reason_) end_ += count;
    }

    Found next(Frame& frame, std::string_view& text) noexcept {
        if (reason_) return Found::broken;
        const std::size_t available = end_ - start_;
        const std::uint8_t* const message = buffer_.data() + start_;
        if (available < kLengthSize) return Found::nothing;
        const std::size_t length = detail::big_endian<std::uint32_t>(message);
        const std::size_t longest = 1 + std::max(max_json_length_, kHeader + kPdoSizeWithOrientation);
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

    /// As if new: for another connection.
    void reset() noexcept {
        start_ = end_ = 0;
        reason_ = nullptr;
    }

private:
    static constexpr std::size_t kPrefix = 5, kLengthSize = 4;  // the length; the type is behind it
    static constexpr std::size_t kHeader = 28;
    static constexpr std::size_t kMinRoom = 65536;
    static constexpr unsigned kTypeData = 1, kTypeJson = 2;

    Found broken(const char* reason) noexcept {
        reason_ = reason;
        start_ = end_ = 0;
        return Found::broken;
    }

    std::size_t max_json_length_;
    std::vector<std::uint8_t> buffer_;
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

/// What the sensor's filters delay alike.
enum class Channel : std::uint8_t { force_torque, acceleration, angular_rate };

/// Group delay of the filters of each `Channel`, ns; none: not known.
using Delays = std::array<std::optional<std::int64_t>, 3>;

/// A sensor as the server describes it.
struct SensorInfo {
    std::uint8_t sensor = 0;  ///< position on the bus
    std::uint64_t serial = 0;
    std::uint32_t pdo_size = 0;  ///< bytes of process data
    double rate_hz = 0.0;        ///< 0: not known
    Delays delay_ns;
    Text<32> name, hardware, firmware, state;
    // Settings that decide what the numbers mean. None: the server does not say.
    std::optional<bool> calibration_matrix, coordinate_system, inertia_compensation, orientation_estimation;
    std::optional<int> imu_active;
    std::optional<bool> fir;
    std::optional<std::array<double, 6>> offset;  ///< that the sensor itself adds (object 0x8000), N and Nm; none: not known
};

/// What `describe` and `subscribe` answer.
struct Description {
    Text<32> version;              ///< the server's
    std::size_t sensor_count = 0;  ///< of these in `sensors`
    std::array<SensorInfo, kMaxSensors> sensors;

    /// The sensor at this position; null if there is none.
    const SensorInfo* find(std::uint8_t position) const noexcept {
        const SensorInfo* const end = sensors.data() + sensor_count;
        const auto* const found = std::find_if(sensors.data(), end, [&](const auto& each) { return each.sensor == position; });
        return found == end ? nullptr : found;
    }
};

namespace detail {

inline bool read(json::Value six, std::array<double, 6>& into) noexcept {
    std::size_t count = 0;
    six.for_each([&](json::Value, json::Value each) {
        if (count < into.size() && each.get(into[count])) ++count;
        else count = into.size() + 1;
    });
    return count == into.size();
}

/// What a description or an event says of a sensor's own offset, if it does.
inline void read_offset(json::Value of, SensorInfo& into) noexcept {
    if (const json::Value offset = of["offset"]) {
        std::array<double, 6> six{};
        into.offset.reset();
        if (read(offset, six)) into.offset = six;
    }
}

/// What a description or an event says of a sensor's rate, delays and settings; what it does not say stays as it was.
inline void read_in_force(json::Value of, SensorInfo& into) noexcept {
    double rate_hz = 0.0;
    if (of["rate_hz"].get(rate_hz) && rate_hz > 0.0 && rate_hz <= 1e6) into.rate_hz = rate_hz;
    if (const json::Value delay_ms = of["delay_ms"]; delay_ms.is_object()) {
        constexpr const char* kChannels[] = {"force_torque", "acceleration", "angular_rate"};
        for (std::size_t i = 0; i < into.delay_ns.size(); ++i) {
            double ms = -1.0;
            into.delay_ns[i].reset();
            if (delay_ms[kChannels[i]].get(ms) && ms >= 0.0 && ms < 1e5)
                into.delay_ns[i] = static_cast<std::int64_t>(std::nearbyint(ms * 1e6));
        }
    }
    const json::Value settings = of["settings"];
    const auto get = [&settings](const char* name, auto& setting) {
        auto value = setting.value_or(0);
        if (settings[name].get(value)) setting = value;
    };
    get("calibration_matrix", into.calibration_matrix);
    get("coordinate_system", into.coordinate_system);
    get("inertia_compensation", into.inertia_compensation);
    get("orientation_estimation", into.orientation_estimation);
    get("imu_active", into.imu_active);
    get("fir", into.fir);
    read_offset(of, into);
}

/// False if this is no description, or one of another protocol version.
inline bool read_description(json::Value reply, Description& into) noexcept {
    int protocol = 0;
    if (!reply["protocol"].get(protocol) || protocol != kProtocolVersion || !reply["sensors"].is_array()) return false;
    into = Description();
    reply["version"].get(into.version);
    reply["sensors"].for_each([&into](json::Value, json::Value each) {
        if (into.sensor_count == kMaxSensors) return;
        SensorInfo& info = into.sensors[into.sensor_count++];
        each["sensor"].get(info.sensor);
        each["serial"].get(info.serial);
        each["pdo_size"].get(info.pdo_size);
        each["name"].get(info.name);
        each["hardware"].get(info.hardware);
        each["firmware"].get(info.firmware);
        each["state"].get(info.state);
        read_in_force(each, info);
    });
    return true;
}

}  // namespace detail

}  // namespace bota_ethercat
