// Time and short texts without allocation, for the other headers.
#ifndef BOTA_ETHERCAT_TEXT_HPP
#define BOTA_ETHERCAT_TEXT_HPP

#include <time.h>

#include <array>
#include <charconv>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <string_view>

namespace bota_ethercat {

using std::chrono::nanoseconds;

/// CLOCK_MONOTONIC in ns: what intervals and ages are measured with.
inline std::int64_t monotonic_now_ns() noexcept {
    timespec now{};
    clock_gettime(CLOCK_MONOTONIC, &now);
    return std::int64_t{now.tv_sec} * 1'000'000'000 + now.tv_nsec;
}

namespace detail {

/// `now` plus a duration, without overflow: a very long one is "never".
inline std::int64_t after(std::int64_t now_ns, nanoseconds duration) noexcept {
    constexpr std::int64_t never = std::numeric_limits<std::int64_t>::max();
    const std::int64_t more = duration.count() < 0 ? 0 : duration.count();
    return more > never - now_ns ? never : now_ns + more;
}

}  // namespace detail

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

}  // namespace bota_ethercat

#endif  // BOTA_ETHERCAT_TEXT_HPP
