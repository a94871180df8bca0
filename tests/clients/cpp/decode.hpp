// Decodes streams with the C++ client's decoder and prints what comes of them, for tests that compare it with Python.
//
// `driver decode` reads streams of bytes, `driver decode accounting` streams of frames.
//
// In: a line for each stream, `MAX_JSON_LENGTH UNITS CHUNK CHUNK ...`; units `g_dps` or `si`, chunks hexadecimal.
// Out: a line for each outcome, then an empty one.
//   D sequence stamp_ns monotonic_ns sensor flags wkc size status warnings saturated x3, 13 numbers, then 4 or `-`
//   J the JSON object, in ASCII         B a JSON message that was refused         X the framing is broken
//
// Accounting, in: `EVERY FRESH_ONLY RATE_HZ`, then SEQUENCE,MONOTONIC_NS,FLAGS for each frame, or `begin`.
// Out: a line with the kind of each frame, then the counts.
#pragma once

#include <bota_ethercat.hpp>

#include <cinttypes>
#include <iostream>
#include <sstream>

namespace {

using namespace bota_ethercat;

void print_text(json::Value text) {
    std::putchar('"');
    text.for_each_character([](char32_t c) {
        if (c >= 0x10000) {
            c -= 0x10000;
            std::printf("\\u%04x\\u%04x", 0xD800u + static_cast<unsigned>(c >> 10), 0xDC00u + static_cast<unsigned>(c & 0x3FF));
        } else if (c < 0x20 || c > 0x7E || c == U'"' || c == U'\\') {
            std::printf("\\u%04x", static_cast<unsigned>(c));
        } else {
            std::putchar(static_cast<int>(c));
        }
    });
    std::putchar('"');
}

// Recursive, as no client needs to be: the depth was checked.
void print_value(json::Value value) {
    if (value.is_string()) return print_text(value);
    if (!value.is_object() && !value.is_array()) {
        const std::string_view text = value.text();
        std::fwrite(text.data(), 1, text.size(), stdout);
        return;
    }
    std::putchar(value.is_object() ? '{' : '[');
    const char* separator = "";
    value.for_each([&](json::Value name, json::Value item) {
        std::fputs(separator, stdout);
        if (value.is_object()) print_value(name), std::putchar(':');
        print_value(item);
        separator = ",";
    });
    std::putchar(value.is_object() ? '}' : ']');
}

void print_frame(const Frame& frame, ImuUnits units) {
    Sample sample;
    if (!decode(frame.process_data, frame.size, units, sample)) std::abort();
    std::printf("D %" PRIu64 " %" PRIu64 " %" PRIu64 " %u %u %u %zu %u %" PRIu32 " %u %u %u", frame.sequence, frame.stamp_ns,
                frame.monotonic_ns, unsigned{frame.sensor}, unsigned{frame.flags}, unsigned{frame.wkc}, frame.size,
                unsigned{sample.status}, sample.warnings, unsigned{sample.force_torque_saturated},
                unsigned{sample.acceleration_saturated}, unsigned{sample.angular_rate_saturated});
    for (const double number : sample.array()) std::printf(" %a", number);
    std::printf(" %a", sample.temperature);
    if (sample.has_orientation)
        for (const double number : sample.orientation) std::printf(" %a", number);
    else
        std::printf(" -");
    std::printf(" %s\n", sample.is_finite() ? "finite" : "not-finite");
}

/// Print every message there is; false once the framing is broken.
bool drain(FrameDecoder& decoder, ImuUnits units) {
    Frame frame;
    std::string_view text;
    for (;;) {
        switch (decoder.next(frame, text)) {
            case FrameDecoder::Found::nothing: return true;
            case FrameDecoder::Found::broken: return false;
            case FrameDecoder::Found::data: print_frame(frame, units); break;
            case FrameDecoder::Found::json: {
                // A copy of just this size, so that reading behind its end is found.
                const std::unique_ptr<char[]> copy(new char[text.size()]);
                std::memcpy(copy.get(), text.data(), text.size());
                const std::string_view same(copy.get(), text.size());
                if (!json::is_object(same)) {
                    std::printf("B\n");
                    break;
                }
                std::printf("J ");
                print_value(json::Value(same));
                std::printf("\n");
            }
        }
    }
}

std::string from_hex(const std::string& digits) {
    std::string bytes;
    for (std::size_t i = 0; i + 1 < digits.size(); i += 2) {
        unsigned byte = 0;
        std::from_chars(digits.data() + i, digits.data() + i + 2, byte, 16);
        bytes.push_back(static_cast<char>(byte));
    }
    return bytes;
}

void account(const std::string& line) {
    constexpr const char* kKinds[] = {"new", "repeated", "invalid", "old"};
    std::istringstream words(line);
    StreamAccounting accounting;
    words >> accounting.every >> accounting.fresh_only >> accounting.rate_hz;
    for (std::string word; words >> word;) {
        if (word == "begin") {
            accounting.begin();
            continue;
        }
        std::istringstream numbers(word);
        std::uint64_t sequence = 0, monotonic_ns = 0;
        unsigned flags = 0;
        char comma = 0;
        numbers >> sequence >> comma >> monotonic_ns >> comma >> flags;
        std::printf("%s ", kKinds[static_cast<int>(accounting.count(sequence, monotonic_ns, static_cast<std::uint8_t>(flags)))]);
    }
    const StreamCounts& c = accounting.counts;
    for (const std::uint64_t count : {c.samples, c.repeated, c.invalid, c.old, c.restarts, c.gaps, c.withheld, c.lost, c.skipped})
        std::printf("%" PRIu64 " ", count);
    std::printf("\n");
}

int decode(bool accounting) {
    std::ios::sync_with_stdio(false);
    if (accounting) {
        for (std::string line; std::getline(std::cin, line);) account(line);
        return 0;
    }
    for (std::string line; std::getline(std::cin, line);) {
        std::istringstream words(line);
        std::size_t max_json_length = 0;
        std::string units_name, chunk;
        words >> max_json_length >> units_name;
        const ImuUnits units = units_name == "si" ? ImuUnits::si : ImuUnits::g_dps;
        FrameDecoder decoder(max_json_length);
        bool whole = true;
        while (whole && words >> chunk) {
            const std::string bytes = from_hex(chunk);
            for (std::size_t at = 0; whole && at < bytes.size();) {
                std::size_t room = 0;
                std::uint8_t* const into = decoder.space(room);
                const std::size_t count = std::min(room, bytes.size() - at);
                std::memcpy(into, bytes.data() + at, count);
                decoder.received(count);
                at += count;
                whole = drain(decoder, units);
            }
        }
        if (!whole) std::printf("X\n");
        std::printf("\n");
    }
    return 0;
}

}  // namespace
