// A sensor in a control loop, without ROS: connect and check it, then `read` it once a cycle.
//
//     SensorLoop loop(parameters, log);
//     if (!loop.open(why) || !loop.wait_until_usable(why)) return fail(why);
//     while (running) if (!loop.read()) stop_controllers();      // loop.values() has the state interfaces
//
// `read` allocates nothing, takes no locks, never blocks or logs; its system calls are recv() and, once for a lost
// connection, close(). One thread at a time calls these methods; the connector's is the only other one.
#pragma once

#include <chrono>
#include <memory>
#include <string>
#include <thread>
#include <utility>

#include <bota_ethercat.hpp>

#include "bota_ethercat_hardware/connector.hpp"
#include "bota_ethercat_hardware/gate.hpp"
#include "bota_ethercat_hardware/parameters.hpp"

namespace bota_ethercat_hardware {

class SensorLoop {
public:
    SensorLoop(Parameters parameters, Log log)
        : parameters_(std::move(parameters)), connector_(parameters_, std::move(log)), gate_(parameters_) {}
    ~SensorLoop() { connector_.stop(); }

    /// Connect, check the sensor, begin to watch the connection. Waits.
    bool open(std::string& why) {
        client_ = connector_.open(why);
        if (!client_) return false;
        connector_.start();
        return true;
    }

    const Identity& identity() const { return connector_.identity(); }
    const Parameters& parameters() const noexcept { return parameters_; }
    double max_age() const { return bota_ethercat_hardware::max_age(parameters_, identity()); }

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
        Client* const next = connector_.replace(client_.get());
        if (next != client_.get()) {
            (void)client_.release();  // the connector destroys it
            client_.reset(next);
        }
        const bota_ethercat::Reading reading = client_->latest(parameters_.sensor);
        age_is_lower_bound_ = reading.age_is_lower_bound;
        const bool is_checked = client_->reconfigurations() == 0;
        if (!client_->connected())
            connector_.ask(client_->error());
        else if (!is_checked)
            connector_.ask("the sensor's settings were changed");
        const bool good = gate_.take(reading, is_checked, bota_ethercat::monotonic_now_ns());
        connector_.tell(gate_.condition());
        return good;
    }

    const Values& values() const noexcept { return gate_.values(); }
    int condition() const noexcept { return gate_.condition(); }

    /// The server is on another machine: ages count from the arrival.
    bool age_is_lower_bound() const noexcept { return age_is_lower_bound_; }

    /// For the control thread after an error: no connection any more, and the connector's thread ends soon; does not wait.
    void stop_soon() noexcept {
        connector_.stop_soon();
        client_->close();
    }

private:
    using Client = bota_ethercat::Client;

    Parameters parameters_;
    Connector connector_;
    Gate gate_;
    std::unique_ptr<Client> client_;
    bool age_is_lower_bound_ = false;
};

}  // namespace bota_ethercat_hardware
