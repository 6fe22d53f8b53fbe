// Run an exported controller as controller_manager does. Each line of input is answered by one line of output:
//   a M*6          activate with these measured struts, m; prints 0 for success
//   u T M*6 R*6    one cycle at T, s, with measured struts and references, m; prints commands and states
//   c X            leave or enter chained mode
//   e X            set enable_compensation
//   t PART C       a temperature, degrees Celsius
//   s              print level, message and values of ~/status
#include <iostream>
#include <limits>
#include <sstream>

#include "stubs.hpp"

controller_interface::ChainableControllerInterface * made();

static void read(std::istream & words, double * values)
{
  std::string word;  // a stream cannot read "nan" as a number
  for (int i = 0; i < 6 && words >> word; i++) {values[i] = std::stod(word);}
}

int main()
{
  std::unique_ptr<controller_interface::ChainableControllerInterface> controller(made());
  double commands[6], measured[6];
  controller->on_init();
  const bool configured = controller->on_configure({}) == controller_interface::CallbackReturn::SUCCESS;
  auto references = controller->on_export_reference_interfaces();
  auto states = controller->on_export_state_interfaces();
  const auto asked = controller->command_interface_configuration().names;
  for (size_t i = 0; i < asked.size(); i++) {
    controller->command_interfaces_.emplace_back("hardware", asked[i], &commands[i]);
    controller->state_interfaces_.emplace_back("hardware", asked[i], &measured[i]);
  }
  std::cout << configured;
  for (const auto & reference : references) {std::cout << " " << reference.name;}
  std::cout << std::endl;
  std::cout.precision(17);
  const auto node = controller->get_node();
  for (std::string line, kind; std::getline(std::cin, line); ) {
    std::istringstream words(line);
    words >> kind;
    if (kind == "a") {
      read(words, measured);
      std::cout << static_cast<int>(controller->on_activate({})) << std::endl;
    } else if (kind == "u") {
      double time, given[6];
      words >> time;
      read(words, measured);
      read(words, given);
      for (size_t i = 0; i < 6; i++) {(void)references[i].set_value(given[i]);}
      controller->update_and_write_commands(rclcpp::Time(time), {});
      for (double command : commands) {std::cout << command << " ";}
      for (const auto & state : states) {std::cout << *state.get_optional() << " ";}
      std::cout << std::endl;
    } else if (kind == "c") {
      int chained;
      words >> chained;
      std::cout << controller->on_set_chained_mode(chained) << std::endl;
    } else if (kind == "e") {
      int enabled;
      words >> enabled;
      node->parameters["enable_compensation"] = {enabled != 0};
      node->timer->callback();
      std::cout << std::endl;
    } else if (kind == "t") {
      sensor_msgs::msg::Temperature message;
      words >> message.header.frame_id >> message.temperature;
      node->subscription->callback(message);
      std::cout << std::endl;
    } else {
      node->timer->callback();
      const auto & said = node->publisher->last;
      std::cout << static_cast<int>(said.level) << " " << said.message;
      for (const auto & [key, value] : said.values) {std::cout << "|" << key << "=" << value;}
      std::cout << std::endl;
    }
  }
}
