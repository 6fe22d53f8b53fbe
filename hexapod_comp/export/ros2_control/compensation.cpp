// SPDX-License-Identifier: Apache-2.0
//
// Compensation of one hexapod between the drives and a controller of nominal strut lengths such as joint_trajectory_controller.
// Inputs are six references, outputs six commands; exported states are the measured strut lengths minus the corrections. The
// arithmetic is core/hexapod_comp.h, the machine core/hexapod_model.h. update() does not allocate, lock or print.

#include <algorithm>
#include <array>
#include <atomic>
#include <chrono>
#include <cmath>
#include <limits>
#include <string>
#include <vector>

#include "controller_interface/chainable_controller_interface.hpp"
#include "diagnostic_msgs/msg/diagnostic_status.hpp"
#include "pluginlib/class_list_macros.hpp"
#include "sensor_msgs/msg/temperature.hpp"

#include "core/hexapod_comp.h"

extern "C" const hc_model * hc_machine(void);  // machine.c

namespace @PACKAGE@
{
using controller_interface::CallbackReturn;
using controller_interface::InterfaceConfiguration;
using controller_interface::return_type;
using diagnostic_msgs::msg::DiagnosticStatus;
using sensor_msgs::msg::Temperature;
using Lengths = std::array<double, 6>;

constexpr double UNKNOWN = std::numeric_limits<double>::quiet_NaN();
constexpr double FOLLOWED_WITHIN = 0.1;  // s: the struts must be near a command of this last time span
constexpr double MOVED = 0.1;            // share of following_error_limit: a larger motion must change the readings
constexpr size_t MOST_STATUSES = 64;     // larger than the number of hc_status values
const std::vector<std::string> PARTS = {
  "strut_1", "strut_2", "strut_3", "strut_4", "strut_5", "strut_6", "base", "platform"};

// Reasons for which references are not used, in addition to the core's refusals.
enum Guard { NONE, NO_REFERENCES, NO_FEEDBACK, STALE, FOLLOWING_ERROR };
constexpr std::array<const char *, 5> GUARD_TEXTS = {
  "compensating", "no references", "no feedback: a strut's state is not finite",
  "stale: commands move, but the struts' states do not; deactivate and activate the controller to continue",
  "following_error: the struts do not follow the commands; deactivate and activate the controller to continue"};

class Compensation : public controller_interface::ChainableControllerInterface
{
public:
  CallbackReturn on_init() override
  {
    auto_declare<std::vector<std::string>>("joints", {PARTS.begin(), PARTS.begin() + 6});
    auto_declare<double>("ramp_rate", 1e-3);
    auto_declare<double>("following_error_limit", 2e-3);
    auto_declare<bool>("enable_compensation", true);
    return CallbackReturn::SUCCESS;
  }

  InterfaceConfiguration command_interface_configuration() const override
  {
    InterfaceConfiguration asked{controller_interface::interface_configuration_type::INDIVIDUAL, {}};
    for (const auto & joint : joints_) {asked.names.push_back(joint + "/position");}
    return asked;
  }

  InterfaceConfiguration state_interface_configuration() const override {return command_interface_configuration();}

  CallbackReturn on_configure(const rclcpp_lifecycle::State &) override
  {
    const auto node = get_node();
    joints_ = node->get_parameter("joints").as_string_array();
    ramp_rate_ = node->get_parameter("ramp_rate").as_double();
    limit_ = node->get_parameter("following_error_limit").as_double();
    if (joints_.size() != 6 || !(ramp_rate_ > 0.0) || !(limit_ >= 0.0)) {
      RCLCPP_ERROR(
        node->get_logger(), "joints must be 6 names, found %zu; ramp_rate must be above 0 m/s, found %g; "
        "following_error_limit must be 0 (off) or more, m, found %g", joints_.size(), ramp_rate_, limit_);
      return CallbackReturn::ERROR;
    }
    recent_.resize(static_cast<size_t>(std::max(2.0, std::ceil(FOLLOWED_WITHIN * get_update_rate()))));
    temperatures_ = node->create_subscription<Temperature>(
      "~/temperatures", 10, [this](const Temperature & message) {
        const auto part = std::find(PARTS.begin(), PARTS.end(), message.header.frame_id);
        if (part != PARTS.end()) {degrees_[part - PARTS.begin()] = message.temperature;}
      });
    status_ = node->create_publisher<DiagnosticStatus>("~/status", rclcpp::QoS(1).transient_local());
    timer_ = node->create_wall_timer(std::chrono::milliseconds(100), [this]() {publish_status();});
    return CallbackReturn::SUCCESS;
  }

  CallbackReturn on_activate(const rclcpp_lifecycle::State &) override
  {
    hc_init(&state_, hc_machine(), ramp_rate_);
    enable_ = get_node()->get_parameter("enable_compensation").as_bool();
    enabled_ = hc_enable(&state_, enable_) == HC_OK && enable_;
    for (auto & value : degrees_) {value = UNKNOWN;}
    Lengths measured, nominal;
    hc_answer answer;
    hc_status status = measure(measured) ? HC_OK : HC_NOT_FINITE;
    nominal = measured;
    for (int turn = 0; turn < 3 && status == HC_OK; turn++) {  // find nominal lengths whose command is the measured one
      hc_state trial = state_;
      status = hc_command_lengths(&trial, nominal.data(), {0.0, UNKNOWN}, &answer);
      for (int i = 0; i < 6; i++) {nominal[i] = measured[i] - (correction_[i] = answer.correction[i]);}
    }
    if (status != HC_OK || (status = hc_reset(&state_, measured.data())) != HC_OK) {
      RCLCPP_ERROR(get_node()->get_logger(), "cannot start at the measured struts: %s", hc_reason(status));
      return CallbackReturn::ERROR;
    }
    std::copy(nominal.begin(), nominal.end(), state_interfaces_values_.begin());
    std::fill(reference_interfaces_.begin(), reference_interfaces_.end(), UNKNOWN);
    std::fill(recent_.begin(), recent_.end(), measured);
    command_ = measured_ = measured;
    stopped_ = NONE;
    unchanged_ = 0;
    began_ = UNKNOWN;
    return CallbackReturn::SUCCESS;
  }

protected:
  std::vector<hardware_interface::CommandInterface> on_export_reference_interfaces() override
  {
    return exported<hardware_interface::CommandInterface>(reference_interfaces_);
  }

  std::vector<hardware_interface::StateInterface> on_export_state_interfaces() override
  {
    return exported<hardware_interface::StateInterface>(state_interfaces_values_);
  }

  bool on_set_chained_mode(bool) override  // clears the references of the previous controller
  {
    std::fill(reference_interfaces_.begin(), reference_interfaces_.end(), UNKNOWN);
    return true;
  }

  return_type update_reference_from_subscribers(const rclcpp::Time &, const rclcpp::Duration &) override
  {
    return return_type::OK;  // references come only from another controller
  }

  return_type update_and_write_commands(const rclcpp::Time & time, const rclcpp::Duration &) override
  {
    const auto begun = std::chrono::steady_clock::now();
    if (std::isnan(began_)) {began_ = time.seconds();}
    const double now = time.seconds() - began_;  // a small number keeps more digits of a second
    if (enable_ != enabled_ && hc_enable(&state_, enable_) == HC_OK) {enabled_ = enable_.load();}
    for (size_t i = 0; i < PARTS.size(); i++) {
      const double degrees = degrees_[i].exchange(UNKNOWN);
      if (!std::isnan(degrees) && hc_set_temperature(&state_, static_cast<int>(i), degrees, now) != HC_OK) {
        refused_temperatures_++;
      }
    }
    Lengths measured;
    const auto missing = [](double length) {return std::isnan(length);};
    Guard guard = measure(measured) ? stopped_ : NO_FEEDBACK;
    if (guard == NONE) {guard = stopped_ = followed(measured);}
    if (guard == NONE && std::any_of(reference_interfaces_.begin(), reference_interfaces_.end(), missing)) {
      guard = NO_REFERENCES;
    }
    if (guard == NONE) {command(now);}
    for (int i = 0; i < 6; i++) {
      state_interfaces_values_[i] = measured[i] - correction_[i];
      if (!command_interfaces_[i].set_value(command_[i])) {unwritten_++;}
    }
    recent_[next_++ % recent_.size()] = command_;
    guard_ = guard;
    const double taken = std::chrono::duration<double, std::micro>(std::chrono::steady_clock::now() - begun).count();
    longest_ = std::max(longest_.load(), taken);
    spent_ = spent_ + taken;
    calls_++;
    return return_type::OK;
  }

private:
  template<class Interface>
  std::vector<Interface> exported(std::vector<double> & values)
  {
    values.assign(6, UNKNOWN);
    std::vector<Interface> interfaces;
    for (int i = 0; i < 6; i++) {
      interfaces.emplace_back(std::string(get_node()->get_name()) + "/" + joints_[i], "position", &values[i]);
    }
    return interfaces;
  }

  bool measure(Lengths & measured) const
  {
    for (int i = 0; i < 6; i++) {measured[i] = state_interfaces_[i].get_optional().value_or(UNKNOWN);}
    return std::all_of(measured.begin(), measured.end(), [](double length) {return std::isfinite(length);});
  }

  Guard followed(const Lengths & measured)
  {
    unchanged_ = measured == measured_ ? unchanged_ + 1 : 0;
    measured_ = measured;
    for (int i = 0; i < 6 && limit_ > 0.0; i++) {
      const auto shorter = [i](const Lengths & a, const Lengths & b) {return a[i] < b[i];};
      const auto [low, high] = std::minmax_element(recent_.begin(), recent_.end(), shorter);
      if (measured[i] < (*low)[i] - limit_ || measured[i] > (*high)[i] + limit_) {return FOLLOWING_ERROR;}
      if (unchanged_ >= recent_.size() && (*high)[i] - (*low)[i] > MOVED * limit_) {return STALE;}
    }
    return NONE;
  }

  void command(double now)
  {
    hc_answer answer;
    last_status_ = hc_command_lengths(&state_, reference_interfaces_.data(), {now, UNKNOWN}, &answer);
    if (last_status_ != HC_OK) {  // command_ keeps the last command
      refused_[last_status_ == HC_STROKE_SHORT ? HC_STROKE_LONG : last_status_.load()]++;
      return;
    }
    std::copy(answer.command, answer.command + 6, command_.begin());
    std::copy(answer.correction, answer.correction + 6, correction_.begin());
    commands_++;
  }

  void publish_status()
  {
    enable_ = get_node()->get_parameter("enable_compensation").as_bool();
    const int guard = guard_, status = last_status_;
    const bool refused = guard == NONE && status != HC_OK;
    DiagnosticStatus message;
    message.name = std::string(get_node()->get_name()) + ": state";
    message.hardware_id = hc_machine()->machine;
    message.level = refused || guard > NO_REFERENCES ? DiagnosticStatus::ERROR :
      guard == NO_REFERENCES ? DiagnosticStatus::WARN : DiagnosticStatus::OK;
    message.message = refused ? std::string("refused: ") + hc_reason(static_cast<hc_status>(status)) : GUARD_TEXTS[guard];
    const auto add = [&message](const std::string & key, const std::string & value) {
        message.values.emplace_back();
        message.values.back().key = key;
        message.values.back().value = value;
      };
    add("model", hc_machine()->model);
    add("compensation", enabled_ ? "on" : "off");
    add("commands", std::to_string(commands_));
    for (size_t i = 0; i < MOST_STATUSES; i++) {
      if (refused_[i]) {
        add(std::string("refused_") + hc_reason(static_cast<hc_status>(i)), std::to_string(refused_[i]));
      }
    }
    add("bad_temperatures", std::to_string(refused_temperatures_));
    add("not_written", std::to_string(unwritten_));
    add("call_us_mean", std::to_string(spent_ / static_cast<double>(std::max<uint64_t>(calls_, 1))));
    add("call_us_max", std::to_string(longest_));
    status_->publish(message);
  }

  std::vector<std::string> joints_;
  double ramp_rate_ = 0.0, limit_ = 0.0, began_ = UNKNOWN;
  hc_state state_{};
  Lengths command_{}, correction_{}, measured_{};
  std::vector<Lengths> recent_;  // ring buffer of the commands of the last FOLLOWED_WITHIN seconds
  size_t next_ = 0, unchanged_ = 0;
  Guard stopped_ = NONE;
  // Shared by the control loop and the executor's thread:
  std::array<std::atomic<double>, 8> degrees_{};
  std::atomic<bool> enable_{true}, enabled_{true};
  std::atomic<int> guard_{NO_REFERENCES}, last_status_{HC_OK};
  std::array<std::atomic<uint64_t>, MOST_STATUSES> refused_{};
  std::atomic<uint64_t> commands_{0}, refused_temperatures_{0}, unwritten_{0}, calls_{0};
  std::atomic<double> longest_{0.0}, spent_{0.0};
  rclcpp::Subscription<Temperature>::SharedPtr temperatures_;
  rclcpp::Publisher<DiagnosticStatus>::SharedPtr status_;
  rclcpp::TimerBase::SharedPtr timer_;
};
}  // namespace @PACKAGE@

PLUGINLIB_EXPORT_CLASS(@PACKAGE@::Compensation, controller_interface::ChainableControllerInterface)
