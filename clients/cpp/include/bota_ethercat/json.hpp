// Reads the server's replies and events, no tree, no allocation, no recursion: `is_object` checks a text whole; after that
// a `Value` is a piece of it that is known to be well-formed.
#ifndef BOTA_ETHERCAT_JSON_HPP
#define BOTA_ETHERCAT_JSON_HPP

#include <array>
#include <charconv>
#include <cstddef>
#include <string_view>
#include <system_error>
#include <type_traits>

#include "bota_ethercat/json_scanner.hpp"
#include "bota_ethercat/text.hpp"

namespace bota_ethercat {

namespace json {

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

}  // namespace bota_ethercat

#endif  // BOTA_ETHERCAT_JSON_HPP
