// Run runtime.hpp on a table of measurements; prints one line of JSON for each row.
//
//     replay BUNDLE LAYERS.json TABLE.csv [aligned|limits|hand-over|hand-over-reset]
//
// The table has the columns of golden.csv. The network is lists of layers, as plain loops: those of each
// input, and those of all their answers side by side. Memory, if the contract has it, counts steps and is
// added to the actions.
#include <iostream>
#include <sstream>

#include "runtime.hpp"

using mjlab::json;
using Floats = std::vector<float>;

struct Layer {
  std::string kind;
  Floats weight, bias;
  std::vector<int> shape;  // Of a convolution: channels in, side of the kernel, stride, padding.
};

/// Return the convolution of square images.
Floats convolution(const Layer& layer, const Floats& x) {
  const int in = layer.shape.at(0), side = layer.shape.at(1), stride = layer.shape.at(2),
            pad = layer.shape.at(3), size = static_cast<int>(std::lround(std::sqrt(x.size() / in))),
            count = (size + 2 * pad - side) / stride + 1;
  Floats y;
  for (size_t out = 0; out < layer.bias.size(); ++out)
    for (int row = 0; row < count; ++row)
      for (int column = 0; column < count; ++column) {
        double sum = layer.bias[out];
        for (int k = 0; k < in * side * side; ++k) {
          const int i = row * stride - pad + k / side % side, j = column * stride - pad + k % side;
          const int channel = k / side / side, from = (channel * size + i) * size + j;
          if (i >= 0 && i < size && j >= 0 && j < size)
            sum += layer.weight.at(out * in * side * side + k) * x.at(from);
        }
        y.push_back(static_cast<float>(sum));
      }
  return y;
}

/// Return the mean place of each image, of the rows (`weight`) and columns (`bias`) of its pixels.
Floats mean_places(const Layer& layer, const Floats& x) {
  const size_t count = layer.weight.size();
  Floats y;
  for (size_t begin = 0; begin < x.size(); begin += count) {
    const float largest = *std::max_element(&x[begin], &x[begin] + count);
    double total = 0.0, row = 0.0, column = 0.0;
    for (size_t k = 0; k < count; ++k) {
      const double share = std::exp(x[begin + k] - largest);
      total += share;
      row += share * layer.weight[k];
      column += share * layer.bias[k];
    }
    y.push_back(static_cast<float>(row / total));
    y.push_back(static_cast<float>(column / total));
  }
  return y;
}

Floats answer(const Layer& layer, const Floats& x) {
  if (layer.kind == "convolution") return convolution(layer, x);
  if (layer.kind == "mean_places") return mean_places(layer, x);
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
  std::map<std::string, std::vector<Layer>> layers;
  const json lists = read_json(arguments[2]);
  for (const auto& [name, list] : lists.items()) {
    std::vector<Layer>& chain = layers[name];
    for (const json& layer : list)
      chain.push_back({layer["kind"], layer["weight"], layer["bias"], layer["shape"]});
  }
  const auto network = [&layers](const std::vector<std::string>& outputs,
                                 const std::vector<mjlab::Input>& inputs) {
    Floats action;
    for (const mjlab::Input& input : inputs) {
      if (!layers.count(input.name)) continue;
      Floats found = input.data;
      for (const Layer& layer : layers.at(input.name)) found = answer(layer, found);
      action.insert(action.end(), found.begin(), found.end());
    }
    for (const Layer& layer : layers.at("actions")) action = answer(layer, action);
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
