// A sensor in a control loop, without ROS: connect and check it, then `read` it once a cycle.
//
//     SensorLoop loop(parameters, log);
//     if (!loop.open(why) || !loop.wait_until_usable(why)) return fail(why);
//     while (running) if (!loop.read()) stop_controllers();      // loop.values() has the state interfaces
//
// `read` allocates nothing, takes no locks, never blocks or logs, and makes no system call. One thread at a time calls these
// methods; the receiver's is the only other one.
#pragma once

#include <chrono>
#include <string>
#include <thread>
#include <utility>

#include <bota_ethercat.hpp>

#include "bota_ethercat_hardware/gate.hpp"
#include "bota_ethercat_hardware/parameters.hpp"
#include "bota_ethercat_hardware/receiver.hpp"

namespace bota_ethercat_hardware {

class SensorLoop {
public:
    SensorLoop(Parameters parameters, Log log)
        : parameters_(std::move(parameters)), receiver_(parameters_, std::move(log)), gate_(parameters_) {}

    /// Connect, check the sensor, begin to receive. Waits.
    bool open(std::string& why) { return receiver_.open(why); }

    const Identity& identity() const { return receiver_.identity(); }
    /// s up to which a sample is fresh now: another rate may make it another.
    double max_age() noexcept { return static_cast<double>(receiver_.latest().max_age_ns) * 1e-9; }
    /// Whether the age counts from the arrival: the server is on another machine.
    bool age_is_lower_bound() noexcept { return receiver_.latest().reading.age_is_lower_bound; }

    /// Set the sensor's offset so that it reads zero now. Waits for its samples.
    bool tare(std::string& why) {
        bota_ethercat::Control control(parameters_.host, parameters_.port);
        bota_ethercat::TareResult result;
        if (control.tare(result, parameters_.sensor)) return true;
        why = std::string("the sensor could not be tared: ") + control.error();
        return false;
    }

    /// Wait for a sample that was taken from now on and that controllers may use.
    bool wait_until_usable(std::string& why, std::chrono::nanoseconds timeout = std::chrono::seconds(2)) {
        const std::int64_t begin = bota_ethercat::monotonic_now_ns();
        do {
            (void)read();
            const double since = static_cast<double>(bota_ethercat::monotonic_now_ns() - begin) * 1e-9;
            if (gate_.usable() && values()[kAge] <= since) {
                gate_.restart();
                return true;
            }
            std::this_thread::sleep_for(std::chrono::milliseconds(1));
        } while (bota_ethercat::monotonic_now_ns() - begin < timeout.count());
        why = "no usable sample within " + detail::text(static_cast<double>(timeout.count()) * 1e-9) + " s; " +
              condition_text(gate_.condition());
        return false;
    }

    /// Once a cycle. False: it is an error by the parameters.
    bool read() noexcept {
        const bool good = gate_.take(receiver_.latest(), bota_ethercat::monotonic_now_ns());
        receiver_.tell(gate_.condition());
        return good;
    }

    const Values& values() const noexcept { return gate_.values(); }
    int condition() const noexcept { return gate_.condition(); }

    /// The receiver's thread ends soon; does not wait.
    void stop_soon() noexcept { receiver_.stop_soon(); }

private:
    Parameters parameters_;
    Receiver receiver_;
    Gate gate_;
};

}  // namespace bota_ethercat_hardware
