// Checks that a text is one JSON object, as strictly as protocol/text/json_text.py: no allocation, no recursion.
#ifndef BOTA_ETHERCAT_JSON_SCANNER_HPP
#define BOTA_ETHERCAT_JSON_SCANNER_HPP

#include <array>
#include <charconv>
#include <cstddef>
#include <string_view>
#include <system_error>

#if !defined(__cpp_lib_to_chars) || __cpp_lib_to_chars < 201611L
#error "bota_ethercat needs std::from_chars for double: use g++ 11 or newer, or clang with libstdc++"
#endif

namespace bota_ethercat {

inline constexpr int kMaxJsonDepth = 32;              // containers in each other
inline constexpr std::size_t kMaxJsonDigits = 4300;   // of a whole number: Python's own limit

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

}  // namespace json

}  // namespace bota_ethercat

#endif  // BOTA_ETHERCAT_JSON_SCANNER_HPP
