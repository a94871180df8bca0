// SPDX-License-Identifier: Apache-2.0
// What a subscriber of one of the ROS 2 node's topics has lost: call `receive(message->header.stamp, now_ns)` in the topic's
// callback, `published(*report)` in that of the node's ~/published. Needs no ROS itself; for one thread; allocates.
// The same as ros2_bridge/bridge/subscription.py, which explains it.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <deque>
#include <string>
#include <utility>

namespace bota_ethercat {

class Subscription {
public:
  std::int64_t received = 0;  // messages
  std::int64_t lost = 0;      // published by the node, but not received, between the reports that were compared
  std::int64_t missing = 0;   // samples not received for whatever reason, by the grid of the stamps
  std::int64_t age_ns = 0;    // of the newest message
  double rate_hz = 0;         // of the sensor; 0: no report so far

  explicit Subscription(std::string topic) : topic_(std::move(topic)) {}  // its resolved name

  template <class Time>
  void receive(const Time& stamp, std::int64_t now_ns) {
    const std::int64_t stamp_ns = std::int64_t{stamp.sec} * 1000000000 + stamp.nanosec;
    if (!stamps_.empty() && (stamp_ns <= stamps_.back() || stamps_.size() == kMost)) begin();
    else if (!stamps_.empty()) {
      const auto steps = std::llround(static_cast<double>(stamp_ns - stamps_.back()) * rate_hz / 1e9);
      if (steps > 1) missing += steps - 1;
    }
    stamps_.push_back(stamp_ns);
    ++received;
    age_ns = now_ns - stamp_ns;
    while (!reports_.empty() && reports_.front().first < stamp_ns) compare();
  }

  template <class Report>
  void published(const Report& report) {
    for (const auto& status : report.status) {
      if (status.name != topic_ || stamps_.empty()) continue;
      std::pair<std::int64_t, std::int64_t> newest{};
      for (const auto& each : status.values) {
        if (each.key == "stamp_ns") newest.first = std::strtoll(each.value.c_str(), nullptr, 10);
        if (each.key == "count") newest.second = std::strtoll(each.value.c_str(), nullptr, 10);
        if (each.key == "rate_hz") rate_hz = std::strtod(each.value.c_str(), nullptr);
      }
      if (newest.first < newest_.first || newest.second < newest_.second) begin();
      else if (newest.first >= stamps_.front() || count_ >= 0) {
        reports_.push_back(newest_ = newest);
        if (newest.first < stamps_.back()) compare();
      }
    }
  }

  void end() {  // no more messages come
    while (!reports_.empty()) compare();
  }

private:
  static constexpr std::size_t kMost = 65536;

  void begin() {
    stamps_.clear();
    reports_.clear();
    newest_ = {-1, -1};
    count_ = -1;
  }

  void compare() {
    const auto [stamp_ns, count] = reports_.front();
    reports_.pop_front();
    std::int64_t here = 0;
    for (; !stamps_.empty() && stamps_.front() <= stamp_ns; ++here) stamps_.pop_front();
    if (count_ >= 0) lost += count - count_ - here;
    count_ = count;
  }

  std::string topic_;
  std::deque<std::int64_t> stamps_;                            // received since the last report that was compared
  std::deque<std::pair<std::int64_t, std::int64_t>> reports_;  // stamp and count, to be compared
  std::pair<std::int64_t, std::int64_t> newest_{-1, -1};
  std::int64_t count_ = -1;  // of the last report that was compared
};

}  // namespace bota_ethercat
