// Reads a topic's name, then a line for each message (r SEC NANOSEC) and report (p TOPIC COUNT STAMP_NS RATE_HZ).
#include <bota_ethercat/subscription.hpp>
#include <iostream>
#include <vector>

struct Time {
  std::int32_t sec;
  std::uint32_t nanosec;
};
struct KeyValue {
  std::string key, value;
};
struct Status {
  std::string name;
  std::vector<KeyValue> values;
};
struct Report {
  std::vector<Status> status;
};

int main() {
  std::string word;
  std::cin >> word;
  bota_ethercat::Subscription subscription(word);
  while (std::cin >> word) {
    if (word == "r") {
      Time time{};
      std::cin >> time.sec >> time.nanosec;
      subscription.receive(time, 0);
    } else {
      Status status{{}, {{"count", ""}, {"stamp_ns", ""}, {"rate_hz", ""}}};
      std::cin >> status.name;
      for (auto& each : status.values) std::cin >> each.value;
      subscription.published(Report{{status}});
    }
  }
  std::cout << subscription.received << " " << subscription.lost << " " << subscription.missing << "\n";
}
