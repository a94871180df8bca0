// SPDX-License-Identifier: Apache-2.0
// The plugin `bota_ethercat_hardware/ForceTorqueSensor`: a SensorLoop as a component of ros2_control.
//
// Reading goes on while the component is inactive, where trouble is only seen (NaN, `condition`); once active, trouble that
// lasts makes read() fail. What is done in which condition, and what is refused: sensor_loop.hpp.
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "bota_ethercat_hardware/sensor_loop.hpp"
#include "hardware_interface/sensor_interface.hpp"
#include "pluginlib/class_list_macros.hpp"
#include "rclcpp/rclcpp.hpp"

namespace bota_ethercat_hardware {

using hardware_interface::CallbackReturn;
using hardware_interface::return_type;

class ForceTorqueSensor : public hardware_interface::SensorInterface {
public:
    CallbackReturn on_init(const hardware_interface::HardwareComponentInterfaceParams& params) override {
        if (SensorInterface::on_init(params) != CallbackReturn::SUCCESS) return CallbackReturn::ERROR;
        parameters_ = Parameters();
        std::string wrong = read_sensors();
        for (const auto& [name, value] : info_.hardware_parameters)
            if (wrong.empty()) wrong = set_parameter(parameters_, name, value);
        if (wrong.empty() && parameters_.wants_compensated && !parameters_.has_payload)
            wrong = "the compensated wrench needs the parameter payload_file, or tool_mass and tool_center_of_gravity";
        return wrong.empty() ? CallbackReturn::SUCCESS : refuse(wrong, CallbackReturn::ERROR);
    }

    CallbackReturn on_configure(const rclcpp_lifecycle::State&) override {
        handles_.clear();
        for (const auto& sensor : info_.sensors)
            for (const auto& interface : sensor.state_interfaces)
                handles_.emplace_back(get_state_interface_handle(sensor.name + "/" + interface.name), index_of(sensor, interface.name));
        loop_ = std::make_unique<SensorLoop>(parameters_, [this](Level level, const std::string& text) { log(level, text); });
        std::string why;
        if (!loop_->open(why)) {
            loop_.reset();
            return refuse(why, CallbackReturn::FAILURE);
        }
        introduce();
        return CallbackReturn::SUCCESS;
    }

    CallbackReturn on_activate(const rclcpp_lifecycle::State&) override {
        std::string why;
        if (parameters_.on_activate_tare && !loop_->tare(why)) return refuse(why, CallbackReturn::FAILURE);
        if (!loop_->wait_until_usable(why)) return refuse(why, CallbackReturn::FAILURE);
        if (loop_->reading().age_is_lower_bound)
            log(Level::warning, "the server is on another machine: the age counts from the arrival, without network latency");
        show();
        is_active_ = true;
        return CallbackReturn::SUCCESS;
    }

    CallbackReturn on_deactivate(const rclcpp_lifecycle::State&) override {
        is_active_ = false;
        return CallbackReturn::SUCCESS;
    }

    CallbackReturn on_cleanup(const rclcpp_lifecycle::State& state) override {
        loop_.reset();
        return on_deactivate(state);
    }

    CallbackReturn on_shutdown(const rclcpp_lifecycle::State& state) override { return on_cleanup(state); }

    /// In the control thread if read() has failed, and then twice: the receiving thread is told to end, not waited for.
    CallbackReturn on_error(const rclcpp_lifecycle::State&) override {
        if (is_active_) log(Level::error, std::string("given up: ") + condition_text(loop_->condition()));
        is_active_ = false;
        if (loop_) loop_->stop_soon();
        return CallbackReturn::SUCCESS;  // unconfigured: may be configured again
    }

    return_type read(const rclcpp::Time&, const rclcpp::Duration&) override {
        if (!loop_) return return_type::OK;
        const bool good = loop_->read();
        show();
        return good || !is_active_ ? return_type::OK : return_type::ERROR;
    }

private:
    /// The index in `Values` of a state interface; the second <sensor> has those of the compensated wrench.
    std::size_t index_of(const hardware_interface::ComponentInfo& sensor, const std::string& name) const {
        return signal(&sensor == &info_.sensors[0] ? name : "compensated." + name);
    }

    /// Each <sensor> of the URDF; what is wrong with it, or nothing.
    std::string read_sensors() {
        if (info_.sensors.empty() || info_.sensors.size() > 2 || !info_.joints.empty() || !info_.gpios.empty())
            return "its <ros2_control> tag must have one <sensor>, perhaps a second one for the compensated wrench, and nothing else";
        for (const auto& sensor : info_.sensors) {
            if (sensor.state_interfaces.empty()) return "the <sensor> " + sensor.name + " has no <state_interface>";
            for (const auto& interface : sensor.state_interfaces) {
                const std::size_t which = index_of(sensor, interface.name);
                if (which == kSignals.size()) return detail::unknown("state interface", interface.name, kSignals);
                if (interface.data_type != "double")
                    return "the state interface " + interface.name + " has the data type " + interface.data_type + "; it must be double";
                if (which >= kImu && which < kOrientation) parameters_.wants_imu = true;
                if (which >= kOrientation && which < kTemperature) parameters_.wants_orientation = true;
                if (which >= kCompensated && which < kMeasured) parameters_.wants_compensated = true;
            }
        }
        return {};
    }

    /// Which sensor it is, and what its user should know of it.
    void introduce() {
        const SensorInfo& sensor = loop_->sensor();
        const auto rate = detail::text(sensor.rate_hz);
        log(Level::info, "sensor " + std::to_string(parameters_.sensor()) + " is " + detail::named(sensor) + ", " + rate +
                             " Hz; a sample is fresh up to " + detail::text(loop_->max_age()) + " s");
        if (sensor.rate_hz > 0.0 && sensor.rate_hz < 0.99 * info_.rw_rate)
            log(Level::warning, "the sensor gives " + rate + " samples a second and is read " + std::to_string(info_.rw_rate) +
                                    " times: some cycles see the sample of the cycle before");
        if (parameters_.wants_orientation && (sensor.pdo_size == bota_ethercat::kPdoSize || sensor.orientation_estimation == false))
            log(Level::warning, "the sensor does not estimate its orientation, so that is NaN: switch its setting orientation_estimation "
                                "on (77 bytes of process data), or let imu_sensor_broadcaster say so (static_covariance_orientation)");
        if (sensor.coordinate_system == true)
            log(Level::warning, "the sensor's setting coordinate_system is on: forces are in the frame stored in the sensor");
        if (sensor.inertia_compensation == true)
            log(Level::warning, "the sensor's setting inertia_compensation is on: it subtracts gravity and inertia itself");
        if (const auto& known = loop_->bounds(); known && parameters_.payload.mass > 0.0) {
            const bool is_known = parameters_.payload.accelerometer_offset != Vector3{};
            const auto rest = known->at({0, 0, 9.80665}, {}, {}), turning = known->at({0, 0, 9.80665}, {}, {20, 0, 0});
            log(is_known ? Level::info : Level::warning,
                (is_known ? "the" : "the accelerometer is not identified: use the file of an identification; the") +
                    std::string(" compensated force may be wrong by ") + detail::text(rest[0]) + " N, torque by " + detail::text(rest[1]) +
                    " Nm, at 20 rad/s^2 by " + detail::text(turning[0]) + " N and " + detail::text(turning[1]) + " Nm (95 % of samples)");
        }
    }

    void show() {
        const Values& values = loop_->values();
        for (const auto& [handle, which] : handles_) (void)set_state(handle, values[which], false);
    }

    CallbackReturn refuse(const std::string& why, CallbackReturn result) {
        log(Level::error, why);
        return result;
    }

    void log(Level level, const std::string& text) const {
        if (level == Level::error) RCLCPP_ERROR(get_logger(), "%s", text.c_str());
        else if (level == Level::warning) RCLCPP_WARN(get_logger(), "%s", text.c_str());
        else RCLCPP_INFO(get_logger(), "%s", text.c_str());
    }

    Parameters parameters_;
    std::unique_ptr<SensorLoop> loop_;
    std::vector<std::pair<hardware_interface::StateInterface::SharedPtr, std::size_t>> handles_;  // index in `Values`
    bool is_active_ = false;
};

}  // namespace bota_ethercat_hardware

PLUGINLIB_EXPORT_CLASS(bota_ethercat_hardware::ForceTorqueSensor, hardware_interface::SensorInterface)
