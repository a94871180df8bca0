// SPDX-License-Identifier: Apache-2.0
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
// <bota_ethercat/real_time.hpp> gives a thread a real-time priority, <bota_ethercat/contact.hpp> tells contact and its point.
//
// Units and frames. Force N, torque Nm, acceleration m/s^2, angular rate rad/s, temperature degrees Celsius; all in
//   the sensor's own frame, neither filtered nor compensated. A stationary sensor measures +g along the axis that points up.
// Age. CLOCK_MONOTONIC now minus the sample's. INVALID and REPEATED frames bring no sample: the age of the last one grows.
//   From another machine, whose CLOCK_MONOTONIC is not ours, the age counts from the arrival and is a lower bound.
// Real time. `latest`, `update`, `peek` and `next` throw nothing, allocate nothing and take no locks. `latest` and `update` do
//   not block: usually one recv() and two clock_gettime(), at most 16 recv() and `max_bytes_per_call`. Without a connection each
//   call makes a non-blocking step of reconnecting. Everything else (constructor, `connect`, `Control`) is not for the control loop.
// Threads. None of its own. An object is used by one thread at a time; objects share nothing.
// Network input is not trusted: lengths, depth and numbers are limited, and a server that breaks the framing is disconnected.
#pragma once

#include "bota_ethercat/contact.hpp"
#include "bota_ethercat/control.hpp"
#include "bota_ethercat/real_time.hpp"
#include "bota_ethercat/stream.hpp"
