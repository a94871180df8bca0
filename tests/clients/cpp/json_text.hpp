// Values as JSON, for the programs of these tests.
#pragma once

#include <bota_ethercat.hpp>

#include <cstdio>
#include <string>
#include <string_view>
#include <type_traits>

inline std::string json_text(std::string_view text) {
    std::string result = "\"";
    for (const char c : text) {
        if (c == '"' || c == '\\') result += '\\';
        result += c;
    }
    return result + "\"";
}
inline std::string json_text(const char* text) { return json_text(std::string_view(text)); }
inline std::string json_text(const std::string& text) { return json_text(std::string_view(text)); }
template <std::size_t Size>
std::string json_text(const bota_ethercat::Text<Size>& text) { return json_text(text.view()); }

/// A number; null for NaN, and what Python reads as infinity.
template <typename Number, typename = std::enable_if_t<std::is_arithmetic_v<Number>>>
std::string json_text(Number value) {
    if constexpr (std::is_same_v<Number, bool>) return value ? "true" : "false";
    if constexpr (std::is_integral_v<Number>) return std::to_string(value);
    const auto number = static_cast<double>(value);
    if (bota_ethercat::is_nan(number)) return "null";
    if (!bota_ethercat::is_finite(number)) return number > 0.0 ? "1e999" : "-1e999";
    char text[40];
    std::snprintf(text, sizeof text, "%.17g", number);
    return text;
}

template <typename Value>
std::string json_text(const std::optional<Value>& value) { return value ? json_text(*value) : "null"; }

/// Anything to iterate over, of what `text_of` makes of each item.
template <typename Items, typename TextOf>
std::string json_list(const Items& items, const TextOf& text_of) {
    std::string result;
    for (const auto& item : items) result += (result.empty() ? "" : ",") + text_of(item);
    return "[" + result + "]";
}
template <typename Value, std::size_t Size>
std::string json_text(const std::array<Value, Size>& values) {
    return json_list(values, [](const Value& value) { return json_text(value); });
}

/// An object: `Object()("key", value)("key", value).text()`.
class Object {
public:
    template <typename Value>
    Object& operator()(std::string_view key, const Value& value) { return raw(key, json_text(value)); }
    Object& raw(std::string_view key, std::string_view text) {
        text_.append(text_.empty() ? "" : ",").append(json_text(key)).append(":").append(text);
        return *this;
    }
    std::string text() const { return "{" + text_ + "}"; }

private:
    std::string text_;
};
