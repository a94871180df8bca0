// Prints every sample in order, in SI units: `print_samples [HOST [PORT]]`. The shortest useful program.
#include <bota_ethercat.hpp>

#include <cstdio>
#include <cstdlib>

int main(int argc, char** argv) {
    bota_ethercat::Client sensor(argc > 1 ? argv[1] : "localhost",
                                 static_cast<std::uint16_t>(argc > 2 ? std::atoi(argv[2]) : 12001));
    if (!sensor.connect()) return std::fprintf(stderr, "print_samples: %s\n", sensor.error()), 1;
    for (;;) {
        const bota_ethercat::Reading reading = sensor.next(std::chrono::milliseconds(100));
        const auto& force = reading.sample.force;
        if (reading.is_new)
            std::printf("%8.3f %8.3f %8.3f N, %lld us old\n", force[0], force[1], force[2],
                        static_cast<long long>(reading.age_ns / 1000));
        else
            std::fprintf(stderr, "print_samples: %s %s\n", to_string(reading.condition), sensor.error());
    }
}
