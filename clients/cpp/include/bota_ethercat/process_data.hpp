// The process data of a sensor, decoded: `Sample`, its units and the bits of its registers.
#ifndef BOTA_ETHERCAT_PROCESS_DATA_HPP
#define BOTA_ETHERCAT_PROCESS_DATA_HPP

#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <limits>

namespace bota_ethercat {

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
    bool is_finite() const noexcept { return wrench_is_finite() && imu_is_finite() && std::isfinite(temperature); }

    bool wrench_is_finite() const noexcept { return are_finite(force) && are_finite(torque); }
    /// Acceleration, angular rate and orientation.
    bool imu_is_finite() const noexcept {
        return are_finite(acceleration) && are_finite(angular_rate) && are_finite(orientation);
    }

    /// Whether force or torque went beyond what the sensor can measure.
    bool wrench_is_saturated() const noexcept {
        return (warnings & (kForceTorqueSaturated | kForceTorqueOutOfRange)) != 0 || force_torque_saturated != 0;
    }
    /// Whether acceleration or angular rate went beyond the range that is set.
    bool imu_is_saturated() const noexcept {
        return (warnings & (kAccelerationSaturated | kAngularRateSaturated)) != 0 || acceleration_saturated != 0 ||
               angular_rate_saturated != 0;
    }

private:
    template <std::size_t Size>
    static bool are_finite(const std::array<double, Size>& values) noexcept {
        double total = 0.0;  // a sum of float32 values cannot overflow a double
        for (const double value : values) total += value;
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

}  // namespace bota_ethercat

#endif  // BOTA_ETHERCAT_PROCESS_DATA_HPP
