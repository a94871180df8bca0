// SPDX-License-Identifier: Apache-2.0
// Texts from the network, without allocation or recursion: `Text`, and JSON as strict as bota_ethercat/text/json_text.py.
//
// `json::is_object` checks a text whole; after that a `json::Value` is a piece of it that is known to be well-formed.
#pragma once

#include <algorithm>
#include <array>
#include <charconv>
#include <cstddef>
#include <cstdint>
#include <string_view>
#include <system_error>
#include <type_traits>

#if !defined(__cpp_lib_to_chars) || __cpp_lib_to_chars < 201611L
#error "bota_ethercat needs std::from_chars for double: use g++ 11 or newer, or clang with libstdc++"
#endif

namespace bota_ethercat {

inline constexpr int kMaxJsonDepth = 32;              // containers in each other
inline constexpr std::size_t kMaxJsonDigits = 4300;   // of a whole number: Python's own limit

/// A short NUL-terminated text. What does not fit is cut off between two characters.
template <std::size_t Size>
class Text {
public:
    const char* c_str() const noexcept { return text_.data(); }
    std::string_view view() const noexcept { return {text_.data(), length_}; }
    bool empty() const noexcept { return length_ == 0; }
    void clear() noexcept { length_ = 0, text_[0] = '\0'; }

    /// Add a text in UTF-8. What comes from the network may hold control characters: they become '?'.
    Text& add(std::string_view more) noexcept {
        std::size_t count = std::min(more.size(), Size - 1 - length_);
        if (count < more.size())
            while (count > 0 && (static_cast<unsigned char>(more[count]) & 0xC0) == 0x80) --count;
        for (const char c : more.substr(0, count)) {
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

    /// Add a character; one that there is not, a lone surrogate, becomes U+FFFD.
    Text& add_character(char32_t c) noexcept {
        if (c >= 0xD800 && c < 0xE000) c = 0xFFFD;
        const std::size_t more = c < 0x80 ? 0 : c < 0x800 ? 1 : c < 0x10000 ? 2 : 3;
        constexpr char32_t kLead[] = {0, 0xC0, 0xE0, 0xF0};
        std::array<char, 4> bytes{static_cast<char>(kLead[more] | c >> (6 * more))};
        for (std::size_t i = 1; i <= more; ++i) bytes[i] = static_cast<char>(0x80 | (c >> (6 * (more - i)) & 0x3F));
        return add({bytes.data(), more + 1});
    }

private:
    std::array<char, Size> text_{};
    std::size_t length_ = 0;
};

namespace json {

namespace detail {

constexpr bool is_blank(char c) noexcept { return c == ' ' || c == '\t' || c == '\n' || c == '\r'; }
constexpr bool is_digit(char c) noexcept { return c >= '0' && c <= '9'; }

/// Moves over a text and checks it on the way. Every method moves behind what it names, or returns false.
class Scanner {
public:
    explicit Scanner(std::string_view text) noexcept : p_(text.data()), end_(text.data() + text.size()) {}

    bool at_end() noexcept {
        while (p_ != end_ && is_blank(*p_)) ++p_;
        return p_ == end_;
    }

    /// Blanks and this character.
    bool skip(char c) noexcept {
        const bool found = !at_end() && *p_ == c;
        p_ += found;
        return found;
    }

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
            while (depth > 0 && skip(closing[depth - 1])) --depth, opened = false;
            if (depth == 0) return true;
            if (!opened && !skip(',')) return false;
            if (closing[depth - 1] == '}' && (at_end() || !string() || !skip(':'))) return false;
        }
    }

    /// The text of the value; empty if it is not well-formed.
    std::string_view piece() noexcept {
        const char* const from = at_end() ? end_ : p_;
        return value() ? std::string_view(from, static_cast<std::size_t>(p_ - from)) : std::string_view();
    }

    bool string() noexcept { return string([](char32_t) {}); }

    /// `give` gets each code point. A lone surrogate, which JSON can spell, comes as it is.
    template <typename Give>
    bool string(Give&& give) noexcept {
        if (p_ == end_ || *p_++ != '"') return false;
        while (p_ != end_ && *p_ != '"') {
            char32_t c = 0;
            if (!(*p_ == '\\' ? escape(c) : utf8(c) && c >= 0x20)) return false;
            give(c);
        }
        const bool closed = p_ != end_;
        p_ += closed;
        return closed;
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

    /// Strict: not overlong, no surrogate, not cut off.
    bool utf8(char32_t& c) noexcept {
        const auto lead = static_cast<unsigned char>(*p_);
        const int more = lead < 0x80 ? 0 : lead >> 5 == 6 ? 1 : lead >> 4 == 14 ? 2 : lead >> 3 == 30 ? 3 : -1;
        if (more < 0 || end_ - p_ <= more) return false;
        c = more == 0 ? lead : lead & (0x3Fu >> more);
        for (int i = 1; i <= more; ++i) {
            const auto next = static_cast<unsigned char>(p_[i]);
            if (next >> 6 != 2) return false;
            c = c << 6 | (next & 0x3Fu);
        }
        constexpr char32_t kLeast[] = {0, 0x80, 0x800, 0x10000};
        if (c < kLeast[more] || c > 0x10FFFF || (c >= 0xD800 && c < 0xE000)) return false;
        p_ += more + 1;
        return true;
    }

    bool escape(char32_t& c) noexcept {
        constexpr std::string_view kKinds = "\"\\/bfnrt", kMeanings = "\"\\/\b\f\n\r\t";
        if (++p_ == end_) return false;
        if (*p_ != 'u') {
            const std::size_t found = kKinds.find(*p_++);
            if (found == std::string_view::npos) return false;
            c = static_cast<unsigned char>(kMeanings[found]);
            return true;
        }
        if (!four_digits(c)) return false;
        if (c >= 0xD800 && c < 0xDC00 && end_ - p_ >= 2 && p_[0] == '\\' && p_[1] == 'u') {
            const char* const before = p_++;
            char32_t low = 0;
            if (!four_digits(low)) return false;
            if (low >= 0xDC00 && low < 0xE000) c = 0x10000 + ((c - 0xD800) << 10) + (low - 0xDC00);
            else p_ = before;
        }
        return true;
    }

    /// The u and what is behind it.
    bool four_digits(char32_t& c) noexcept {
        std::uint16_t value = 0;
        if (end_ - p_ < 5 || std::from_chars(p_ + 1, p_ + 5, value, 16).ptr != p_ + 5) return false;
        p_ += 5;
        c = value;
        return true;
    }

    bool number() noexcept {
        const char* const digits = p_ + (*p_ == '-');
        if (digits == end_ || !is_digit(*digits)) return false;
        const bool zero = *digits == '0';
        if (zero && end_ - digits > 1 && is_digit(digits[1])) return false;
        double value = 0.0;
        const auto [behind, error] = std::from_chars(p_, end_, value);
        const std::string_view text(digits, static_cast<std::size_t>(behind - digits));
        p_ = behind;
        const std::size_t point = text.find('.'), exponent = text.find_first_of("eE");
        if (point == text.npos && exponent == text.npos) return text.size() <= kMaxJsonDigits;
        if (point != text.npos && (point + 1 == text.size() || !is_digit(text[point + 1]))) return false;
        // Out of range is too large, as JSON for infinity, or next to nothing, which is fine.
        return error == std::errc() || (exponent == text.npos ? zero : text[exponent + 1] == '-');
    }

    const char* p_;
    const char* end_;
};

}  // namespace detail

/// Whether `text` is one JSON object in UTF-8 within the limits above.
inline bool is_object(std::string_view text) noexcept {
    detail::Scanner scanner(text);
    const std::string_view value = scanner.piece();
    return !value.empty() && value.front() == '{' && scanner.at_end();
}

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

    bool get(bool& value) const noexcept {
        if (text_ != "true" && text_ != "false") return false;
        value = text_ == "true";
        return true;
    }

    /// A number as double, or a whole number that fits; anything else is false and leaves `value` as it was.
    template <typename Number, typename = std::enable_if_t<std::is_arithmetic_v<Number>>>
    bool get(Number& value) const noexcept {
        if (first() != '-' && !detail::is_digit(first())) return false;
        Number found = 0;
        const char* const end = text_.data() + text_.size();
        const auto done = std::from_chars(text_.data(), end, found);
        // A double that is out of range and was accepted with a fraction or exponent is next to nothing.
        const bool tiny = std::is_floating_point_v<Number> && text_.find_first_of(".eE") != std::string_view::npos;
        if ((done.ec != std::errc() && !tiny) || done.ptr != end) return false;
        value = done.ec == std::errc() ? found : Number{0};
        return true;
    }

    /// A string, cut off where it does not fit.
    template <std::size_t Size>
    bool get(Text<Size>& value) const noexcept {
        if (!is_string()) return false;
        value.clear();
        for_each_character([&value](char32_t c) { value.add_character(c); });
        return true;
    }

    /// Give the characters of a string to `give`; a lone surrogate, which JSON can spell, as it is.
    template <typename Give>
    void for_each_character(Give&& give) const noexcept {
        (void)detail::Scanner(text_).string(give);
    }

    /// Whether it is this string, spelled without escapes, as the server spells names.
    bool is(std::string_view wanted) const noexcept {
        return is_string() && text_.substr(1, text_.size() - 2) == wanted;
    }

    /// Give `give` the name, a string, and the value of each member of an object, or no name and each item of an array.
    template <typename Give>
    void for_each(Give&& give) const noexcept {
        if (!is_object() && !is_array()) return;
        for (detail::Scanner scanner(text_.substr(1, text_.size() - 2)); !scanner.at_end(); (void)scanner.skip(',')) {
            const Value name(is_object() ? scanner.piece() : std::string_view());
            if (is_object()) (void)scanner.skip(':');
            give(name, Value(scanner.piece()));
        }
    }

    /// The member of this name, the last one if there are several; no value if there is none.
    Value operator[](std::string_view name) const noexcept {
        Value found;
        if (is_object())
            for_each([&](Value key, Value value) { found = key.is(name) ? value : found; });
        return found;
    }

private:
    char first() const noexcept { return text_.empty() ? '\0' : text_.front(); }

    std::string_view text_;
};

}  // namespace json

}  // namespace bota_ethercat
