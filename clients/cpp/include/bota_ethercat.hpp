// Samples of Bota Systems EtherCAT force/torque sensors from ethercat-server, for controllers in C++17.
//
//     bota_ethercat::Client sensor("localhost", 12001);
//     if (!sensor.connect()) { std::fprintf(stderr, "%s\n", sensor.error()); return 1; }
//     while (running) {
//         const bota_ethercat::Reading reading = sensor.latest();   // never blocks, never allocates
//         if (reading.fresh()) control(reading.sample.force, reading.sample.torque);
//         else stop_safely(to_string(reading.condition));
//     }
//
// Headers only, Linux, libc only. Protocol version 1 (docs/protocol.md); docs/cpp.md is the manual. This header has everything;
// a controller needs <bota_ethercat/stream.hpp> (`Client`), and not <bota_ethercat/control.hpp> (`Control`: requests).
// <bota_ethercat/real_time.hpp> gives a thread a real-time priority.
//
// Units and frames. Force N, torque Nm, acceleration m/s^2, angular rate rad/s, temperature degrees Celsius; all in
//   the sensor's own frame, neither filtered nor compensated. A stationary sensor measures +g along the axis that points up.
// Age. CLOCK_MONOTONIC now minus the sample's, as the server stamps it. Only a frame that is neither
//   INVALID nor REPEATED brings a sample; the age of an older one grows, whatever else arrives. From another machine,
//   whose CLOCK_MONOTONIC is not ours, the age counts from the arrival and is only a lower bound.
// Real time. `latest`, `update`, `peek` and `next` throw nothing, allocate nothing and take no locks. `latest` and
//   `update` do not block: in the steady state one recv() and two clock_gettime(); never more than 16 and `max_bytes_per_call`.
//   While the connection is down a call makes one non-blocking step of reconnecting, one attempt per `reconnect_every`,
//   or with `Reconnect::when_told` none, and then no system call but clock_gettime().
//   Everything else (constructor, `connect`, `reconnect`, `Control`) is not for the control loop.
// Threads. None of its own. An object is used by one thread at a time; objects share nothing.
// Network input is not trusted: lengths, depth and numbers are limited as in protocol/framing.py, and a server that breaks
//   the framing is disconnected.
#pragma once

#include "bota_ethercat/control.hpp"
#include "bota_ethercat/real_time.hpp"
#include "bota_ethercat/stream.hpp"
