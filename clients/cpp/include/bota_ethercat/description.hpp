// What a server says of itself and its sensors.
#ifndef BOTA_ETHERCAT_DESCRIPTION_HPP
#define BOTA_ETHERCAT_DESCRIPTION_HPP

#include <array>
#include <cstddef>
#include <cstdint>

#include "bota_ethercat/json.hpp"
#include "bota_ethercat/text.hpp"

namespace bota_ethercat {

inline constexpr int kProtocolVersion = 1;
inline constexpr std::size_t kMaxSensors = 16;  // of which a description is kept

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
inline bool read_description(json::Value reply, Description& into) noexcept {
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

}  // namespace bota_ethercat

#endif  // BOTA_ETHERCAT_DESCRIPTION_HPP
