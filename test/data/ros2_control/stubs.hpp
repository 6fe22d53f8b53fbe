// The part of the interfaces of ros2_control and rclcpp that an exported controller uses, so that a test compiles and runs it
// without them. A test writes a file for each real header's name, with one line that includes this file.
#pragma once

#include <chrono>
#include <cstdint>
#include <cstdio>
#include <functional>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <variant>
#include <vector>

#define RCLCPP_ERROR(logger, ...) (static_cast<void>(logger), std::fprintf(stderr, __VA_ARGS__))
#define PLUGINLIB_EXPORT_CLASS(kind, base) base * made() {return new kind();}

namespace diagnostic_msgs::msg
{
struct KeyValue { std::string key, value; };
struct DiagnosticStatus
{
  static constexpr unsigned char OK = 0, WARN = 1, ERROR = 2;
  unsigned char level = OK;
  std::string name, message, hardware_id;
  std::vector<KeyValue> values;
};
}  // namespace diagnostic_msgs::msg

namespace sensor_msgs::msg
{
struct Temperature
{
  struct { std::string frame_id; } header;
  double temperature = 0.0;
};
}  // namespace sensor_msgs::msg

namespace rclcpp
{
struct Logger {};
struct QoS
{
  QoS(size_t) {}
  QoS & transient_local() {return *this;}
};
class Time
{
public:
  explicit Time(double now) : now_(now) {}
  double seconds() const {return now_;}

private:
  double now_;
};
struct Duration {};
template<class Message>
struct Subscription
{
  using SharedPtr = std::shared_ptr<Subscription>;
  std::function<void(const Message &)> callback;
};
template<class Message>
struct Publisher
{
  using SharedPtr = std::shared_ptr<Publisher>;
  void publish(const Message & message) {last = message;}
  Message last;
};
struct TimerBase
{
  using SharedPtr = std::shared_ptr<TimerBase>;
  std::function<void()> callback;
};
struct Parameter
{
  std::variant<bool, double, std::vector<std::string>> value;
  bool as_bool() const {return std::get<bool>(value);}
  double as_double() const {return std::get<double>(value);}
  std::vector<std::string> as_string_array() const {return std::get<std::vector<std::string>>(value);}
};
}  // namespace rclcpp

namespace rclcpp_lifecycle
{
struct State {};
struct LifecycleNode
{
  using Temperature = sensor_msgs::msg::Temperature;
  using Status = diagnostic_msgs::msg::DiagnosticStatus;

  const char * get_name() const {return "compensation";}
  rclcpp::Logger get_logger() const {return {};}
  rclcpp::Parameter get_parameter(const std::string & name) const {return parameters.at(name);}

  template<class Message, class Callback>
  typename rclcpp::Subscription<Message>::SharedPtr create_subscription(const char *, rclcpp::QoS, Callback callback)
  {
    subscription = std::make_shared<rclcpp::Subscription<Message>>();
    subscription->callback = callback;
    return subscription;
  }

  template<class Message>
  typename rclcpp::Publisher<Message>::SharedPtr create_publisher(const char *, rclcpp::QoS)
  {
    return publisher = std::make_shared<rclcpp::Publisher<Message>>();
  }

  rclcpp::TimerBase::SharedPtr create_wall_timer(std::chrono::milliseconds, std::function<void()> callback)
  {
    timer = std::make_shared<rclcpp::TimerBase>();
    timer->callback = std::move(callback);
    return timer;
  }

  std::map<std::string, rclcpp::Parameter> parameters;
  rclcpp::Subscription<Temperature>::SharedPtr subscription;
  rclcpp::Publisher<Status>::SharedPtr publisher;
  rclcpp::TimerBase::SharedPtr timer;
};
}  // namespace rclcpp_lifecycle

namespace hardware_interface
{
struct Interface
{
  Interface(const std::string & prefix, const std::string & last, double * at) : name(prefix + "/" + last), value(at) {}
  [[nodiscard]] bool set_value(double given) {*value = given; return true;}
  std::optional<double> get_optional() const {return *value;}
  std::string name;
  double * value;
};
struct CommandInterface : Interface { using Interface::Interface; };
struct StateInterface : Interface { using Interface::Interface; };
}  // namespace hardware_interface

namespace controller_interface
{
enum class CallbackReturn { SUCCESS, FAILURE, ERROR };
enum class return_type { OK, ERROR };
enum class interface_configuration_type { ALL, INDIVIDUAL, NONE };
struct InterfaceConfiguration
{
  interface_configuration_type type;
  std::vector<std::string> names;
};

class ChainableControllerInterface
{
public:
  virtual ~ChainableControllerInterface() = default;
  virtual CallbackReturn on_init() = 0;
  virtual InterfaceConfiguration command_interface_configuration() const = 0;
  virtual InterfaceConfiguration state_interface_configuration() const = 0;
  virtual CallbackReturn on_configure(const rclcpp_lifecycle::State &) = 0;
  virtual CallbackReturn on_activate(const rclcpp_lifecycle::State &) = 0;
  std::shared_ptr<rclcpp_lifecycle::LifecycleNode> get_node() const {return node_;}
  unsigned get_update_rate() const {return 250;}

  template<class Value>
  void auto_declare(const std::string & name, const Value & value) {node_->parameters[name] = {value};}

  virtual std::vector<hardware_interface::CommandInterface> on_export_reference_interfaces() = 0;
  virtual std::vector<hardware_interface::StateInterface> on_export_state_interfaces() = 0;
  virtual bool on_set_chained_mode(bool) = 0;
  virtual return_type update_reference_from_subscribers(const rclcpp::Time &, const rclcpp::Duration &) = 0;
  virtual return_type update_and_write_commands(const rclcpp::Time &, const rclcpp::Duration &) = 0;

  std::vector<hardware_interface::CommandInterface> command_interfaces_;
  std::vector<hardware_interface::StateInterface> state_interfaces_;
  std::vector<double> reference_interfaces_, state_interfaces_values_;

private:
  std::shared_ptr<rclcpp_lifecycle::LifecycleNode> node_ = std::make_shared<rclcpp_lifecycle::LifecycleNode>();
};
}  // namespace controller_interface
