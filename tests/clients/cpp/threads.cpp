// Clients and requests in several threads, one thread for each object, for ThreadSanitizer: `threads PORT`. A client is handed
// from thread to thread, as a controller does that connects outside its loop.
#include <bota_ethercat.hpp>

#include <cstdio>
#include <cstdlib>
#include <thread>
#include <vector>

using namespace bota_ethercat;

int main(int, char** argv) {
    const auto port = static_cast<std::uint16_t>(std::atoi(argv[1]));
    constexpr int kSamples = 50;
    std::vector<int> samples(3);
    const auto stream = [](Client& sensor, int& count, bool waits) {
        const std::int64_t end = monotonic_now_ns() + 20'000'000'000;
        while (count < kSamples && monotonic_now_ns() < end)
            count += waits ? sensor.next(std::chrono::milliseconds(50)).is_new : sensor.latest().is_new;
    };
    std::vector<std::thread> threads;
    for (std::size_t i = 0; i < 2; ++i) {
        threads.emplace_back([&, i] {
            Client sensor("127.0.0.1", port);
            if (sensor.connect()) stream(sensor, samples[i], i == 0);
        });
    }
    threads.emplace_back([&] {
        Options options;
        options.port = port;
        options.reconnect = Reconnect::when_told;
        Client sensor;
        std::thread([&] {
            Client made(options);
            if (made.connect()) sensor = std::move(made);
        }).join();
        std::thread([moved = std::move(sensor), &stream, &samples]() mutable { stream(moved, samples[2], true); }).join();
    });
    Control control("127.0.0.1", port);
    Description described;
    bool ok = true;
    for (int i = 0; i < 5; ++i) ok = control.describe(described) && ok;
    for (std::thread& thread : threads) thread.join();
    std::printf("%d %d %d %d\n", ok, samples[0], samples[1], samples[2]);
    return ok && samples[0] == kSamples && samples[1] == kSamples && samples[2] == kSamples ? 0 : 1;
}
