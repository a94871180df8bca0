// SPDX-License-Identifier: Apache-2.0
// What a subscriber of one of the ROS 2 node's topics has lost: call `receive(message->header.stamp, now_ns)` in the topic's
// callback, `published(*report)` in that of the node's ~/published. Needs no ROS itself; for one thread; allocates.
// The same as ros2_bridge/bota_ethercat_bridge/subscription.py, which explains it.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <deque>
#include <string>
#include <utility>

namespace bota_ethercat {

class Subscription {
public:
  std::int64_t received = 0, lost = 0, missing = 0, age_ns = 0;
  double rate_hz = 0;

  explicit Subscription(std::string topic) : topic_(std::move(topic)) {}  // its resolved name

  template <class Time>  // builtin_interfaces/Time; now_ns is the time since 1970
  void receive(const Time& stamp, std::int64_t now_ns) {
    const std::int64_t stamp_ns = std::int64_t{stamp.sec} * 1000000000 + stamp.nanosec;
    if (!stamps_.empty() && (stamp_ns <= stamps_.back() || stamps_.size() == kMost)) begin();
    else if (!stamps_.empty())
      missing += std::max(0LL, std::llround(static_cast<double>(stamp_ns - stamps_.back()) * rate_hz / 1e9) - 1);
    stamps_.push_back(stamp_ns);
    ++received;
    age_ns = now_ns - stamp_ns;
    compare(stamp_ns);
  }

  template <class Report>  // diagnostic_msgs/DiagnosticArray
  void published(const Report& report) {
    for (const auto& status : report.status) {
      if (status.name != topic_ || stamps_.empty()) continue;
      Counted newest{};
      for (const auto& each : status.values) {
        if (each.key == "stamp_ns") newest.first = std::strtoll(each.value.c_str(), nullptr, 10);
        if (each.key == "count") newest.second = std::strtoll(each.value.c_str(), nullptr, 10);
        if (each.key == "rate_hz") rate_hz = std::strtod(each.value.c_str(), nullptr);
      }
      if (newest.first < newest_.first || newest.second < newest_.second) return begin();
      if (count_ < 0 && newest.first < stamps_.front()) return;
      reports_.push_back(newest_ = newest);
      return compare(stamps_.back());
    }
  }

private:
  using Counted = std::pair<std::int64_t, std::int64_t>;  // stamp, count
  static constexpr std::size_t kMost = 65536;

  void begin() {
    stamps_.clear();
    reports_.clear();
    newest_ = {-1, -1};
    count_ = -1;
  }

  void compare(std::int64_t before_ns) {
    for (; !reports_.empty() && reports_.front().first < before_ns; reports_.pop_front()) {
      const auto [stamp_ns, count] = reports_.front();
      std::int64_t here = 0;
      for (; stamps_.front() <= stamp_ns; ++here) stamps_.pop_front();
      if (count_ >= 0) lost += count - count_ - here;
      count_ = count;
    }
  }

  std::string topic_;
  std::deque<std::int64_t> stamps_;
  std::deque<Counted> reports_;
  Counted newest_{-1, -1};
  std::int64_t count_ = -1;
};

}  // namespace bota_ethercat
