// SPDX-License-Identifier: Apache-2.0
// Prints every sample in order, in SI units: `print_samples [--server HOST:PORT]`, else from $BOTA_SERVER. The shortest useful program.
#include <bota_ethercat.hpp>

#include <cstdio>
#include <cstring>

int main(int argc, char** argv) {
    bota_ethercat::Options options;
    const bool given = argc == 3 && std::strcmp(argv[1], "--server") == 0;
    if ((argc > 1 && !given) || !bota_ethercat::choose_server(given ? argv[2] : nullptr, options))
        return std::fprintf(stderr, "usage: print_samples [--server HOST:PORT], else $BOTA_SERVER\n"), 2;
    bota_ethercat::Client sensor(options);
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
