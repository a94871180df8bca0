// SPDX-License-Identifier: Apache-2.0
// Real-time scheduling for the calling thread: SCHED_FIFO, a CPU, memory that is never paged out; bota_ethercat/program/real_time.py
// in C++. Each right is used if the system allows it; what is not allowed is said, with what would allow it.
#pragma once

#include <pthread.h>
#include <sched.h>
#include <sys/mman.h>
#include <sys/resource.h>
#include <unistd.h>

#include <string>

namespace bota_ethercat {

/// What the thread was given.
struct Scheduling {
    int priority = 0;            ///< of SCHED_FIFO; 0: ordinary scheduling
    int cpu = -1;                ///< that it is pinned to; -1: none
    bool memory_locked = false;  ///< of the whole process
    std::string refused;         ///< what was not granted, each with what would grant it; empty: nothing
};

/// Give the calling thread SCHED_FIFO `priority` (1 to 98; 0: ordinary scheduling), pin it to `cpu` (-1: none), and with
/// `lock_memory` lock the process's memory, current and future. Threads that it starts later inherit priority and CPU.
/// Allocates: for the start of a program or thread, not for a loop.
inline Scheduling make_real_time(int priority, int cpu = -1, bool lock_memory = false) {
    Scheduling given;
    const auto refuse = [&given](const std::string& what) { given.refused += (given.refused.empty() ? "" : "; ") + what; };
    if (cpu >= 0) {
        cpu_set_t one;
        CPU_ZERO(&one);
        if (cpu < CPU_SETSIZE) CPU_SET(static_cast<std::size_t>(cpu), &one);
        if (sched_setaffinity(0, sizeof one, &one) == 0) given.cpu = cpu;
        else refuse("CPU " + std::to_string(cpu));
    }
    sched_param wanted{};
    wanted.sched_priority = priority;
    if (pthread_setschedparam(pthread_self(), priority > 0 ? SCHED_FIFO : SCHED_OTHER, &wanted) == 0) given.priority = priority;
    else {
        rlimit limit{};
        const std::string number = std::to_string(priority);
        const bool may = getrlimit(RLIMIT_RTPRIO, &limit) == 0 && limit.rlim_cur >= static_cast<rlim_t>(priority);
        refuse("SCHED_FIFO " + number + (may ? " (a container, a control group or RestrictRealtime= forbids it)"
                                             : " ('rtprio " + number + "' in a file in /etc/security/limits.d, LimitRTPRIO=" +
                                                   number + " in a service's unit)"));
    }
    if (lock_memory) {
        rlimit limit{};  // not up to a limit: beyond it every allocation would fail
        const bool may = geteuid() == 0 || (getrlimit(RLIMIT_MEMLOCK, &limit) == 0 && limit.rlim_cur == RLIM_INFINITY);
        given.memory_locked = may && mlockall(MCL_CURRENT | MCL_FUTURE) == 0;
        if (!given.memory_locked)
            refuse("locked memory ('memlock unlimited' in a file in /etc/security/limits.d, LimitMEMLOCK=infinity)");
    }
    return given;
}

}  // namespace bota_ethercat
