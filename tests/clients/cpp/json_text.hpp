// Values as JSON, for the programs of these tests.
#pragma once

#include <string>
#include <string_view>

inline const char* yes(bool value) { return value ? "true" : "false"; }

inline std::string quoted(std::string_view text) {
    std::string result = "\"";
    for (const char c : text) {
        if (c == '"' || c == '\\') result += '\\';
        result += c;
    }
    return result + "\"";
}
