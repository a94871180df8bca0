// Bytes of a framed connection in, messages out (docs/protocol.md).
#ifndef BOTA_ETHERCAT_FRAMING_HPP
#define BOTA_ETHERCAT_FRAMING_HPP

#include <cstddef>
#include <cstdint>
#include <cstring>
#include <memory>
#include <new>
#include <string>
#include <string_view>

#include "bota_ethercat/process_data.hpp"

namespace bota_ethercat {

inline constexpr std::size_t kMaxJsonLength = 65536;  // bytes of one JSON message, as protocol/framing.py

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

}  // namespace bota_ethercat

#endif  // BOTA_ETHERCAT_FRAMING_HPP
