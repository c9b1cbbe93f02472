// Run runtime.hpp on a table of measurements; prints one line of JSON for each row.
//
//     replay BUNDLE LAYERS.json TABLE.csv [aligned|limits|hand-over|hand-over-reset]
//
// The table has the columns of golden.csv. The network is a list of layers, as plain loops. Memory, if
// the contract has it, counts steps and is added to the actions.
#include <iostream>
#include <sstream>

#include "runtime.hpp"

using mjlab::json;
using Floats = std::vector<float>;

struct Layer {
  std::string kind;
  Floats weight, bias;
};

Floats answer(const Layer& layer, const Floats& x) {
  const size_t size = layer.kind == "linear" || layer.kind == "first" ? layer.bias.size() : x.size();
  Floats y(size);
  double mean = 0.0, variance = 0.0;
  for (float value : x) mean += value / static_cast<double>(x.size());
  for (float value : x) variance += (value - mean) * (value - mean) / static_cast<double>(x.size());
  for (size_t i = 0; i < size; ++i) {
    if (layer.kind == "linear") {
      double sum = layer.bias[i];
      for (size_t j = 0; j < x.size(); ++j) sum += layer.weight.at(i * x.size() + j) * x[j];
      y[i] = static_cast<float>(sum);
    } else if (layer.kind == "normalize") {
      y[i] = (x[i] - layer.bias.at(i)) / layer.weight.at(i);
    } else if (layer.kind == "layer_norm") {
      const double scaled = (x[i] - mean) / std::sqrt(variance + 1e-5);
      y[i] = static_cast<float>(scaled * layer.weight.at(i) + layer.bias.at(i));
    } else if (layer.kind == "elu") {
      y[i] = x[i] > 0 ? x[i] : std::expm1(x[i]);
    } else if (layer.kind == "silu") {
      y[i] = x[i] / (1 + std::exp(-x[i]));
    } else if (layer.kind == "tanh") {
      y[i] = std::tanh(x[i]);
    } else if (layer.kind == "first") {
      y[i] = x.at(i);
    } else {
      throw std::invalid_argument("layer " + layer.kind);
    }
  }
  return y;
}

json read_json(const std::string& path) {
  std::ifstream file(path);
  return json::parse(file);
}

std::vector<std::string> split(const std::string& line) {
  std::vector<std::string> cells;
  std::stringstream stream(line);
  for (std::string cell; std::getline(stream, cell, ',');) cells.push_back(cell);
  return cells;
}

void print(const mjlab::Policy& policy, const mjlab::Targets& targets) {
  json row = {{"names", targets.names},         {"position", targets.position},
              {"velocity", targets.velocity},   {"effort", targets.effort},
              {"kp", targets.kp},               {"kd", targets.kd},
              {"period", targets.period},       {"is_damping", targets.is_damping},
              {"reason", targets.reason},       {"is_ready", policy.is_ready()},
              {"action", policy.action()},      {"target", policy.target()},
              {"values", policy.values()}};
  for (const mjlab::Input& input : policy.inputs()) row["inputs"][input.name] = input.data;
  std::cout << row << "\n";
}

int main(int count, char** arguments) {
  const std::string folder = arguments[1], mode = count > 4 ? arguments[4] : "";
  std::vector<Layer> layers;
  for (const json& layer : read_json(arguments[2]))
    layers.push_back({layer["kind"], layer["weight"], layer["bias"]});
  const auto network = [&layers](const std::vector<std::string>& outputs,
                                 const std::vector<mjlab::Input>& inputs) {
    Floats action = inputs[0].data;
    for (const Layer& layer : layers) action = answer(layer, action);
    std::vector<Floats> answers = {action};
    for (size_t k = 1; k < outputs.size(); ++k) {
      answers.push_back(inputs[k].data);
      for (float& value : answers[0]) value += answers[k][0];
      for (float& value : answers[k]) value += 1;
    }
    return answers;
  };
  mjlab::TERMS["my_package.mdp:half"] = [](const auto& inputs, const auto& term) {
    mjlab::Vector half = inputs[0];
    for (double& value : half) value *= term.params.value("share", 0.5);
    return half;
  };
  try {
    mjlab::Policy policy(folder, network, mode != "" && mode != "aligned");
    std::map<size_t, size_t> motions;
    for (const json& episode : policy.contract()["golden"]["episodes"])
      motions[episode["row"]] = episode["motion"];
    std::ifstream table(arguments[3]);
    std::string line;
    std::getline(table, line);
    const std::vector<std::string> names = split(line);
    for (size_t row = 0; std::getline(table, line); ++row) {
      const std::vector<std::string> cells = split(line);
      mjlab::Values values;
      bool is_first = false;
      for (size_t k = 0; k < names.size(); ++k) {
        const std::string stem = names[k].substr(0, names[k].rfind('.'));
        if (names[k] == "time") values.time = std::stod(cells[k]);
        if (names[k] == "first") is_first = cells[k] == "1";
        if (stem.rfind("measurement.", 0) == 0)
          values[stem.substr(12)].push_back(std::stod(cells[k]));
        if (stem.rfind("command.", 0) == 0)
          values["command/" + stem.substr(8)].push_back(std::stod(cells[k]));
      }
      if (is_first) policy.reset(motions[row], mode == "aligned" ? values : mjlab::Values{});
      const bool was_ready = policy.is_ready();
      if (was_ready && mode == "hand-over-reset") policy.reset();
      const bool hands_over = mode.rfind("hand-over", 0) == 0 && !was_ready;
      print(policy, hands_over ? policy.hand_over(values, 0.1) : policy.step(values));
    }
  } catch (const std::invalid_argument& error) {
    std::cerr << error.what() << "\n";
    return 1;
  }
}
