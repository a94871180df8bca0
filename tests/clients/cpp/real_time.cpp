// make_real_time PRIORITY CPU: what the thread was given, and what it has.
#include <bota_ethercat/real_time.hpp>

#include <cstdio>
#include <cstdlib>

int main(int, char** argv) {
    const bota_ethercat::Scheduling given = bota_ethercat::make_real_time(std::atoi(argv[1]), std::atoi(argv[2]), true);
    sched_param has{};
    sched_getparam(0, &has);
    std::printf("%d %d %d %d %d\n%s\n", sched_getscheduler(0), has.sched_priority, given.priority, given.cpu, given.memory_locked,
                given.refused.c_str());
}
