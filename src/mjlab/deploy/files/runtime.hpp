// Run the policy of this folder on a robot. C++17 and nlohmann/json.hpp (Debian: nlohmann-json3-dev).
//
//     mjlab::Policy policy(".", network);       // README.md has a network by onnxruntime
//     while (!policy.is_ready())                // from a standing pose to the first of the policy
//       send(policy.hand_over(measure()));      // then wait until the period is over
//     policy.reset();
//     while (true) send(policy.step(measure(), command));
//
// `measure()` returns the time (s, monotonic) and all measurements that contract.json lists.
// Names and order are those of runtime.py, and so are the answers. Read it, and rewrite it.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <functional>
#include <limits>
#include <map>
#include <nlohmann/json.hpp>
#include <numeric>
#include <optional>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace mjlab {

using json = nlohmann::json;
using Vector = std::vector<double>;

/// Measurements by name, taken at `time` (s, monotonic).
struct Values : std::map<std::string, Vector> {
  double time = 0.0;
};

/// Motor commands of a period: torque = kp (position - q) + kd (velocity - q') + effort.
struct Targets {
  std::vector<std::string> names;
  Vector position, velocity, effort, kp, kd;
  double period = 0.0;
  bool is_damping = false;
  std::string reason;
};

/// Input of the network; data in C order.
struct Input {
  std::string name;
  std::vector<int64_t> shape;
  std::vector<float> data;
};

/// Network: (names of outputs, inputs) -> one vector for each output.
using Network = std::function<std::vector<std::vector<float>>(const std::vector<std::string>&,
                                                              const std::vector<Input>&)>;

struct Term;
/// Formula of an observation term: (values of the inputs, term) -> value.
using Formula = std::function<Vector(const std::vector<Vector>&, const Term&)>;

/// Observation term: settings, and its part of the network input.
struct Term {
  std::string name, input, function;
  Formula formula;
  std::vector<std::string> inputs;
  std::vector<size_t> columns;  // Empty: all.
  Vector offset, scale;         // Empty: none. One number, or one a component.
  double factor = 1.0, low = 0.0, high = 0.0;
  json params;
  size_t size = 0, history = 0;
  std::vector<float> part;       // Oldest value first; (max(history, 1) * size).
  size_t index = 0, begin = 0;   // Place of the part: input, its first element,
  size_t length = 0, stride = 0; // and blocks of `length` elements, `stride` apart.
};

[[noreturn]] inline void fail(const std::string& text) { throw std::invalid_argument(text); }

/// Return lists and numbers as a vector, and null as an empty one.
inline Vector numbers(const json& value) {
  if (value.is_null()) return {};
  return value.is_array() ? value.get<Vector>() : Vector{value.get<double>()};
}

/// Return a bound; null: none.
inline double bound(const json& value, double none) {
  return value.is_null() ? none : value.get<double>();
}

/// Return component `k`; vectors of one number have it for all components.
inline double at(const Vector& x, size_t k) { return x.size() == 1 ? x[0] : x.at(k); }

template <typename Number>
bool is_finite(const std::vector<Number>& x) {
  return std::all_of(x.begin(), x.end(), [](Number value) { return std::isfinite(value); });
}

// Formulas of the observation terms.

using Matrix = std::array<std::array<double, 3>, 3>;

/// Return the matrix of a unit quaternion (w, x, y, z).
inline Matrix rotation(const Vector& q) {
  const double w = q.at(0), x = q.at(1), y = q.at(2), z = q.at(3);
  return {{{1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)},
           {2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)},
           {2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)}}};
}

/// Return R' v.
inline Vector turned_back(const Matrix& r, const Vector& v) {
  Vector result(3, 0.0);
  for (size_t i = 0; i < 3; ++i)
    for (size_t j = 0; j < 3; ++j) result[i] += r[j][i] * v.at(j);
  return result;
}

/// Return factor * x - offset of the chosen components.
inline Vector reading(const std::vector<Vector>& inputs, const Term& term) {
  Vector x = inputs.at(0);
  if (!term.columns.empty()) {
    x.clear();
    for (size_t column : term.columns) x.push_back(inputs[0].at(column));
  }
  for (size_t k = 0; k < x.size(); ++k)
    x[k] = term.factor * x[k] - (term.offset.empty() ? 0.0 : at(term.offset, k));
  return x;
}

inline Vector cos_sin(const std::vector<Vector>& inputs, const Term& term) {
  const Vector x = reading(inputs, term);
  Vector result;
  for (double angle : x) result.push_back(std::cos(angle));
  for (double angle : x) result.push_back(std::sin(angle));
  return result;
}

inline Vector gravity(const std::vector<Vector>& inputs, const Term&) {
  return turned_back(rotation(inputs.at(0)), {0.0, 0.0, -1.0});
}

inline Vector position_in_frame(const std::vector<Vector>& inputs, const Term&) {
  Vector difference(3);
  for (size_t k = 0; k < 3; ++k) difference[k] = inputs.at(0).at(k) - inputs.at(1).at(k);
  return turned_back(rotation(inputs.at(2)), difference);
}

inline Vector vector_in_frame(const std::vector<Vector>& inputs, const Term&) {
  return turned_back(rotation(inputs.at(1)), inputs.at(0));
}

/// Return two columns of the relative rotation matrix, row by row.
inline Vector orientation_in_frame(const std::vector<Vector>& inputs, const Term&) {
  const Matrix of = rotation(inputs.at(0)), frame = rotation(inputs.at(1));
  Vector result;
  for (size_t i = 0; i < 3; ++i)
    for (size_t j = 0; j < 2; ++j)
      result.push_back(frame[0][i] * of[0][j] + frame[1][i] * of[1][j] + frame[2][i] * of[2][j]);
  return result;
}

/// Return translation and rotation vector from a pose to the commanded pose.
inline Vector pose_error(const std::vector<Vector>& inputs, const Term&) {
  const Vector &place = inputs.at(0), &q = inputs.at(1), &goal = inputs.at(2);
  const double w = q.at(0), x = q.at(1), y = q.at(2), z = q.at(3);
  const double a = goal.at(3), b = goal.at(4), c = goal.at(5), d = goal.at(6);
  // Product of the goal's quaternion with the conjugate of q.
  std::array<double, 4> turn = {w * a + x * b + y * c + z * d, -x * a + w * b - z * c + y * d,
                                -y * a + z * b + w * c - x * d, -z * a - y * b + x * c + w * d};
  if (turn[0] < 0) for (double& part : turn) part = -part;
  const double sine = std::sqrt(turn[1] * turn[1] + turn[2] * turn[2] + turn[3] * turn[3]);
  const double ratio = sine > 1e-9 ? 2 * std::atan2(sine, turn[0]) / sine : 2.0;
  return {goal[0] - place.at(0), goal[1] - place.at(1), goal[2] - place.at(2),
          ratio * turn[1],       ratio * turn[2],       ratio * turn[3]};
}

/// Formulas by kind. A term of your own, before the policy is made:
/// `mjlab::TERMS["my_package.mdp:wheel_speed"] = [](const auto& inputs, const auto& term) { ... };`
inline std::map<std::string, Formula> TERMS = {
    {"reading", reading},
    {"command", reading},
    {"last_action", reading},
    {"cos_sin", cos_sin},
    {"gravity", gravity},
    {"position_in_frame", position_in_frame},
    {"vector_in_frame", vector_in_frame},
    {"orientation_in_frame", orientation_in_frame},
    {"pose_error", pose_error},
};

// Motions.

/// Array of numbers, (T, ...).
struct Array {
  size_t rows = 0;
  std::vector<float> data;

  /// Return `count` numbers of row `t`, from number `first` on.
  Vector row(size_t t, size_t first, size_t count) const {
    const auto begin = data.begin() + t * (data.size() / rows) + first;
    return Vector(begin, begin + count);
  }
};

/// Read the float32 arrays of a file written by `numpy.savez` (a zip archive without compression).
inline std::map<std::string, Array> read_npz(const std::filesystem::path& path) {
  std::ifstream file(path, std::ios::binary);
  const auto number = [&file](size_t bytes) {
    uint64_t value = 0;  // Little-endian, as all processors of robots are.
    file.read(reinterpret_cast<char*>(&value), static_cast<std::streamsize>(bytes));
    return value;
  };
  const auto text = [&file](size_t length) {
    std::string value(length, '\0');
    file.read(value.data(), static_cast<std::streamsize>(length));
    return value;
  };
  std::map<std::string, Array> arrays;
  while (number(4) == 0x04034b50) {  // Header of a member.
    file.ignore(4);
    if (number(2) != 0) fail(path.string() + ": compressed; write it with numpy.savez.");
    file.ignore(8);
    uint64_t size = number(4);
    file.ignore(4);
    const uint64_t name_length = number(2), extra_length = number(2);
    const std::string name = text(name_length), extra = text(extra_length);
    // Sizes of 64 bits: after the 4 bytes of the extra field's head.
    if (size == 0xffffffff) std::memcpy(&size, extra.substr(12, 8).data(), 8);
    const auto begin = file.tellg();
    file.ignore(6);  // Magic string of an array.
    const uint64_t version = number(1);
    file.ignore(1);
    const std::string header = text(number(version == 1 ? 2 : 4));
    if (header.find("'<f4'") != std::string::npos && header.find("True") == std::string::npos) {
      Array array;
      array.rows = std::stoul(header.substr(header.find('(') + 1));
      const uint64_t bytes = size - static_cast<uint64_t>(file.tellg() - begin);
      array.data.resize(bytes / sizeof(float));
      file.read(reinterpret_cast<char*>(array.data.data()), static_cast<std::streamsize>(bytes));
      arrays[name.substr(0, name.rfind(".npy"))] = std::move(array);
    }
    file.seekg(begin + static_cast<std::streamoff>(size));
  }
  return arrays;
}

/// Policy with its contract, memory, clocks and limits.
class Policy {
 public:
  /// Read contract.json of a folder. Without limits, targets are those of the policy.
  Policy(const std::filesystem::path& folder, Network network, bool limits = true)
      : network_(std::move(network)), has_limits_(limits) {
    std::ifstream file(folder / "contract.json");
    if (!file) fail((folder / "contract.json").string() + ": not found.");
    contract_ = json::parse(file);
    if (contract_["schema"] != "mjlab-contract" || contract_["version"] != 1)
      fail("contract.json: expected schema mjlab-contract, version 1.");
    period_ = contract_["rates"]["step_dt"];
    outputs_ = {contract_["policy"]["output"]};
    for (const json& joint : contract_["joints"]) {
      names_.push_back(joint["name"]);
      kp_.push_back(joint["kp"]);
      kd_.push_back(joint["kd"]);
      default_.push_back(joint["default_pos"]);
    }
    for (const json& entry : contract_["policy"]["inputs"]) add_input(entry);
    for (const json& observation : contract_["observations"])
      for (const json& term : observation["terms"]) terms_.push_back(make_term(observation, term));
    for (const json& action : contract_["actions"]) actions_.push_back(make_action(action));
    for (const json& command : contract_["commands"])
      if (command["kind"] == "motion") read_motion(folder, command);
    for (const json& entry : contract_["measurements"])
      if (entry.value("is_quaternion", false)) quaternions_.push_back(entry["name"]);
    const json& bounds = contract_["limits"];
    target_low_ = numbers(bounds["target_low"]);
    target_high_ = numbers(bounds["target_high"]);
    target_step_ = numbers(bounds["target_step"]);
    joint_speed_ = numbers(bounds["joint_speed"]);
    clip_ = bound(contract_["policy"]["clip"], std::numeric_limits<double>::infinity());
    action_.resize(contract_["policy"]["size"]);
    reset();
  }

  /// Start an episode, of one of the motions in motion tracking: clear memory, clocks, faults.
  void reset(size_t motion = 0) {
    reason_.clear();
    time_.reset();
    begin_.reset();
    sent_ = std::exchange(handed_, {});  // The first jump is that from the last of the hand-over.
    repeated_ = 0;
    is_first_ = true;
    is_ready_ = false;
    std::fill(action_.begin(), action_.end(), 0.0f);
    motion_ = motion;
    frame_.reset();
    for (const json& command : contract_["commands"]) {
      if (command["kind"] != "motion") continue;
      const size_t first = command["motions"].at(motion)["start"], frame = command["start_frame"];
      default_ = arrays_["joint_pos"].row(first + frame - 1, 0, names_.size());
    }
    for (size_t k : memory_) std::fill(inputs_[k].data.begin(), inputs_[k].data.end(), 0.0f);
    clocks_.clear();
    for (const json& command : contract_["commands"])
      clocks_[command["name"]] = {command.value("start", 0.0f), 0.0f};
  }

  /// Return the motor commands of one period.
  ///
  /// `command` is that of the only given command; several are entries `command/<name>` of the
  /// measurements. After non-finite or stale measurements, a tilt or joint speed beyond the limits,
  /// all steps damp until `reset`. Raises std::invalid_argument if numbers are missing.
  Targets step(const Values& measurements, const Vector& command = {}) {
    Values values = checked(measurements);
    add_commands(values, command);
    values["last_action"] = Vector(action_.begin(), action_.end());
    for (Term& term : terms_) observe(term, values);
    is_first_ = false;
    const std::vector<std::vector<float>> answers = network_(outputs_, inputs_);
    if (answers.size() != outputs_.size() || answers[0].size() != action_.size())
      fail("Network: expected " + std::to_string(action_.size()) + " actions, then the memory.");
    bool finite = is_finite(answers[0]);
    for (const Input& input : inputs_) finite = finite && is_finite(input.data);
    if (!finite && reason_.empty()) reason_ = "a command or the answer of the policy is not finite";
    if (!reason_.empty() && has_limits_) return damp(values["joint_pos"]);
    for (size_t k = 0; k < memory_.size(); ++k) inputs_[memory_[k]].data = answers[k + 1];
    for (size_t k = 0; k < action_.size(); ++k)
      action_[k] = static_cast<float>(std::clamp<double>(answers[0][k], -clip_, clip_));
    return targets();
  }

  /// Move from the measured pose to the first pose of the policy, in `seconds`.
  ///
  /// `is_ready` becomes true when time is over and each joint within `tolerance` (rad, m).
  Targets hand_over(const Values& measurements, double seconds = 2.0, double tolerance = 0.3) {
    handed_.clear();
    const Values values = checked(measurements);
    const Vector& q = found(values, "joint_pos");
    if (!reason_.empty()) return damp(q);
    if (!begin_) begin_ = {measurements.time, q};
    const auto& [start, pose] = *begin_;
    const double share = std::min((measurements.time - start) / seconds, 1.0);
    Vector position(pose);
    double farthest = 0.0;
    for (size_t k = 0; k < q.size(); ++k) {
      position[k] += share * (default_[k] - pose[k]);
      farthest = std::max(farthest, std::abs(q[k] - default_[k]));
    }
    is_ready_ = share == 1.0 && farthest < tolerance;
    Targets result = commanded(position);
    for (const Action& action : actions_)
      for (size_t joint : action.index) handed_.push_back(field(result, action)[joint]);
    return result;
  }

  /// Return commands that only brake: no stiffness, targets at the measured positions.
  Targets damp(Vector q) const {
    for (size_t k = 0; k < q.size(); ++k)
      if (!std::isfinite(q[k])) q[k] = default_[k];
    const Vector zero(names_.size(), 0.0);
    return {names_, std::move(q), zero, zero, zero, kd_, period_, true, reason_};
  }

  const json& contract() const { return contract_; }
  const std::vector<std::string>& names() const { return names_; }
  double period() const { return period_; }
  bool is_ready() const { return is_ready_; }
  /// Values of the terms of the last step, before clip and scale, by `<input>/<term>`.
  const std::map<std::string, Vector>& values() const { return values_; }
  /// Network inputs of the last step.
  const std::vector<Input>& inputs() const { return inputs_; }
  /// Answer of the network in the last step.
  const std::vector<float>& action() const { return action_; }
  /// Targets of the last step before the limits, in order of the actions.
  const Vector& target() const { return target_; }

 private:
  struct Action {
    std::string kind;
    Vector scale, offset, low, high, open, closed;
    std::vector<size_t> index;  // Joints.
    size_t start = 0;           // In the action vector.
  };

  void add_input(const json& entry) {
    Input input{entry["name"], entry["shape"], {}};
    const int64_t count = std::accumulate(input.shape.begin(), input.shape.end(), int64_t{1},
                                          std::multiplies<int64_t>());
    input.data.resize(static_cast<size_t>(count));
    if (entry["kind"] == "memory") {
      memory_.push_back(inputs_.size());
      outputs_.push_back(entry["output"]);
    }
    inputs_.push_back(std::move(input));
  }

  Term make_term(const json& observation, const json& entry) const {
    Term term;
    term.name = entry["name"];
    term.input = observation["input"];
    term.function = entry["function"];
    const std::string kind = entry["kind"];
    const auto known = TERMS.count(kind) ? TERMS.find(kind) : TERMS.find(term.function);
    if (known == TERMS.end())
      fail("Term '" + term.name + "': unknown function '" + term.function +
           "'. Add its formula to mjlab::TERMS under this name; its inputs are the measurements that "
           "contract.json lists for it.");
    term.formula = known->second;
    term.inputs = entry["inputs"].get<std::vector<std::string>>();
    if (kind == "last_action") term.inputs = {"last_action"};
    if (!entry["columns"].is_null()) term.columns = entry["columns"].get<std::vector<size_t>>();
    term.offset = numbers(entry["offset"]);
    term.scale = numbers(entry["scale"]);
    term.factor = bound(entry["factor"], 1.0);
    const double infinity = std::numeric_limits<double>::infinity();
    const json& clip = entry["clip"];
    term.low = clip.is_null() ? -infinity : bound(clip[0], -infinity);
    term.high = clip.is_null() ? infinity : bound(clip[1], infinity);
    term.params = entry["params"];
    term.size = entry["size"];
    term.history = entry["history"]["length"];
    term.part.resize(term.size * std::max<size_t>(term.history, 1));
    // Terms lie side by side along `axis` of the input; `inner` elements follow each index of it.
    const std::vector<size_t> shape = observation["shape"];
    const size_t axis = observation["axis"];
    size_t inner = 1;
    for (size_t k = axis + 1; k < shape.size(); ++k) inner *= shape[k];
    const size_t start = entry["start"], stop = entry["stop"];
    term.begin = start * inner;
    term.length = (stop - start) * inner;
    term.stride = shape.at(axis) * inner;
    while (inputs_.at(term.index).name != term.input) ++term.index;
    return term;
  }

  Action make_action(const json& entry) const {
    if (entry["kind"] == "custom")
      fail("Action '" + entry["name"].get<std::string>() + "' is a " +
           entry["class"].get<std::string>() + ": compute it here.");
    Action action;
    action.kind = entry["kind"];
    action.start = entry["start"];
    for (const std::string name : entry["joints"]) {
      const auto place = std::find(names_.begin(), names_.end(), name);
      if (place == names_.end()) fail("Action: unknown joint '" + name + "'.");
      action.index.push_back(static_cast<size_t>(place - names_.begin()));
    }
    const auto list = [&entry](const char* key) { return numbers(entry.value(key, json())); };
    action.scale = list("scale");
    action.offset = list("offset");
    action.open = list("open");
    action.closed = list("closed");
    // Without a bound: NaN, which fmin and fmax ignore.
    const double none = std::numeric_limits<double>::quiet_NaN();
    const json clip = entry.value("clip", json());
    for (size_t k = 0; k < action.index.size(); ++k) {
      action.low.push_back(clip.is_null() ? none : bound(clip[k][0], none));
      action.high.push_back(clip.is_null() ? none : bound(clip[k][1], none));
    }
    return action;
  }

  void read_motion(const std::filesystem::path& folder, const json& command) {
    arrays_ = read_npz(folder / command["file"].get<std::string>());
    for (const char* name : {"joint_pos", "joint_vel", "body_pos_w", "body_quat_w"})
      if (!arrays_.count(name)) fail(std::string("Motion: no float32 array ") + name + ".");
  }

  static const Vector& found(const Values& values, const std::string& name) {
    const auto place = values.find(name);
    if (place == values.end()) fail("Missing measurement or command '" + name + "'.");
    return place->second;
  }

  /// Return the values; set the reason if they are stale, not finite, or beyond the limits.
  Values checked(const Values& values) {
    for (const json& entry : contract_["measurements"]) {
      const auto given = values.find(entry["name"]);
      if (given != values.end() && given->second.size() != entry["size"])
        fail("Measurement '" + given->first + "': expected " + entry["size"].dump() +
             " numbers, got " + std::to_string(given->second.size()) + ".");
    }
    const std::optional<double> last = std::exchange(time_, values.time);
    if (!reason_.empty() || !has_limits_) return values;
    const double gap = last ? values.time - *last : period_;
    repeated_ = gap <= 0 ? repeated_ + 1 : 0;
    const double age = std::max(gap, repeated_ * period_);
    const json& limits = contract_["limits"];
    const bool finite =
        std::all_of(values.begin(), values.end(), [](const auto& x) { return is_finite(x.second); });
    // A comparison with NaN is false.
    if (!(age <= limits["max_age"].get<double>()))
      reason_ = "no new measurement for " + std::to_string(age) + " s";
    else if (!finite || !std::isfinite(values.time))
      reason_ = "a measurement is not finite";
    else if (is_fast(found(values, "joint_vel")))
      reason_ = "a joint is faster than limits.joint_speed";
    else if (!are_quaternions(values))
      reason_ = "a quaternion is not of length 1";
    else if (!limits["tilt"].is_null() && !limits["tilt_from"].is_null() &&
             rotation(found(values, limits["tilt_from"]))[2][2] <
                 std::cos(limits["tilt"].get<double>()))
      reason_ = "the robot is tilted by more than limits.tilt";
    return values;
  }

  bool are_quaternions(const Values& values) const {
    return std::all_of(quaternions_.begin(), quaternions_.end(), [&values](const auto& name) {
      if (!values.count(name)) return true;
      const Vector& q = values.at(name);
      const double norm = std::sqrt(std::inner_product(q.begin(), q.end(), q.begin(), 0.0));
      return std::abs(norm - 1) <= 0.05;
    });
  }

  bool is_fast(const Vector& speed) const {
    for (size_t k = 0; k < speed.size(); ++k)
      if (std::abs(speed[k]) > at(joint_speed_, k)) return true;
    return false;
  }

  /// Add given commands, gait clocks and motions to `values`.
  void add_commands(Values& values, const Vector& command) {
    const auto count = std::count_if(contract_["commands"].begin(), contract_["commands"].end(),
                                     [](const json& entry) { return entry["kind"] == "given"; });
    if (!command.empty() && count > 1)
      fail("Command: several are given; add each to the measurements, as command/<name>.");
    for (const json& entry : contract_["commands"]) {
      if (entry["kind"] != "given") continue;
      const std::string key = "command/" + entry["name"].get<std::string>();
      if (!command.empty()) values[key] = command;
      const size_t size = found(values, key).size();
      if (size != entry["size"])
        fail(key + ": expected " + entry["size"].dump() + " numbers, got " + std::to_string(size) +
             ".");
    }
    for (const json& entry : contract_["commands"]) {
      const std::string key = "command/" + entry["name"].get<std::string>();
      if (entry["kind"] == "gait_clock") values[key] = clock(entry, values);
      if (entry["kind"] == "motion") play(key, entry, values);
    }
  }

  /// Return (A sin, A cos) of a gait clock, after advancing it; float, as in training.
  Vector clock(const json& entry, const Values& values) {
    auto& [phase, fade] = clocks_[entry["name"]];
    const double fade_s = entry["fade_s"];
    bool stands = false;
    if (!entry["velocity_command"].is_null()) {
      const auto name = entry["velocity_command"].get<std::string>();
      const Vector& v = found(values, "command/" + name);
      const double speed = std::hypot(v.at(0), v.at(1)) + std::abs(v.at(2));
      stands = speed < entry["standing_threshold"].get<double>();
    }
    if (!is_first_) {
      phase = std::fmod(
          phase + static_cast<float>(entry["frequency"].get<double>() * period_), 1.0f);
      const float change = static_cast<float>(stands ? -period_ : period_) /
                           static_cast<float>(fade_s > 0 ? fade_s : 1.0);
      fade = std::clamp(fade + change, 0.0f, 1.0f);
    }
    const float amplitude = fade_s > 0 ? fade : (stands ? 0.0f : 1.0f);
    const float angle = phase * 6.28318530717958648f;
    return {amplitude * std::sin(angle), amplitude * std::cos(angle)};
  }

  /// Add the next frame of the motion; its last frame is held.
  void play(const std::string& key, const json& entry, Values& values) {
    const json& motion = entry["motions"].at(motion_);
    const size_t first = motion["start"], length = motion["length"];
    const size_t ahead = frame_ ? *frame_ + 1 : first + entry["start_frame"].get<size_t>();
    const size_t t = std::min(ahead, first + length - 1), body = entry["anchor_index"];
    frame_ = t;
    Vector& reference = values[key] = arrays_["joint_pos"].row(t, 0, names_.size());
    const Vector speed = arrays_["joint_vel"].row(t, 0, names_.size());
    reference.insert(reference.end(), speed.begin(), speed.end());
    values[key + "/anchor_pos"] = arrays_["body_pos_w"].row(t, 3 * body, 3);
    values[key + "/anchor_quat"] = arrays_["body_quat_w"].row(t, 4 * body, 4);
    for (Input& input : inputs_)
      if (input.name == "time_step") input.data[0] = static_cast<float>(t);
  }

  /// Compute a term, and write it with its history into the network input.
  void observe(Term& term, const Values& values) {
    std::vector<Vector> inputs;
    for (const std::string& name : term.inputs) inputs.push_back(found(values, name));
    const Vector& value = values_[term.input + "/" + term.name] = term.formula(inputs, term);
    if (value.size() != term.size)
      fail("Term '" + term.name + "': expected " + std::to_string(term.size) + " numbers, got " +
           std::to_string(value.size()) + ".");
    const auto newest = term.part.end() - static_cast<std::ptrdiff_t>(term.size);
    std::move(term.part.begin() + static_cast<std::ptrdiff_t>(term.size), term.part.end(),
              term.part.begin());
    for (size_t k = 0; k < term.size; ++k) {
      const double clipped = std::clamp(value[k], term.low, term.high);
      newest[static_cast<std::ptrdiff_t>(k)] =
          static_cast<float>(term.scale.empty() ? clipped : clipped * at(term.scale, k));
    }
    // The first value of an episode fills the history.
    if (is_first_)
      for (auto place = term.part.begin(); place < newest; place += static_cast<std::ptrdiff_t>(term.size))
        std::copy(newest, term.part.end(), place);
    std::vector<float>& data = inputs_[term.index].data;
    for (size_t block = 0; block * term.length < term.part.size(); ++block)
      std::copy_n(&term.part[block * term.length], term.length,
                  &data[term.begin + block * term.stride]);
  }

  /// Return the motor commands that an action sets.
  static Vector& field(Targets& targets, const Action& action) {
    if (action.kind == "joint_velocity") return targets.velocity;
    return action.kind == "joint_effort" ? targets.effort : targets.position;
  }

  Targets commanded(Vector position) const {
    const Vector zero(names_.size(), 0.0);
    return {names_, std::move(position), zero, zero, kp_, kd_, period_, false, ""};
  }

  /// Return the motor commands of the last action, within the limits.
  Targets targets() {
    target_.clear();
    for (const Action& action : actions_)
      for (size_t k = 0; k < action.index.size(); ++k) {
        const bool is_binary = action.kind == "binary_joint_position";
        const double raw = action_.at(action.start + (is_binary ? 0 : k));
        const double target = is_binary ? (raw < 0 ? action.closed : action.open).at(k)
                                        : raw * at(action.scale, k) + at(action.offset, k);
        target_.push_back(std::fmax(std::fmin(target, action.high[k]), action.low[k]));
      }
    Vector sent = target_;
    for (size_t k = 0; has_limits_ && k < sent.size(); ++k) {
      sent[k] = std::clamp(sent[k], target_low_.at(k), target_high_.at(k));
      if (!sent_.empty())
        sent[k] = std::clamp(sent[k], sent_[k] - target_step_.at(k), sent_[k] + target_step_.at(k));
    }
    sent_ = sent;
    Targets result = commanded(default_);
    size_t next = 0;
    for (const Action& action : actions_)
      for (size_t joint : action.index) field(result, action)[joint] = sent[next++];
    return result;
  }

  json contract_;
  Network network_;
  bool has_limits_;
  double period_ = 0.0, clip_ = 0.0;
  std::vector<std::string> names_, outputs_, quaternions_;
  Vector kp_, kd_, default_;
  Vector target_low_, target_high_, target_step_, joint_speed_;
  std::vector<Input> inputs_;
  std::vector<size_t> memory_;  // Inputs that are fed back.
  std::vector<Term> terms_;
  std::vector<Action> actions_;
  std::map<std::string, Array> arrays_;  // Motions.
  // Of the episode.
  std::string reason_;
  std::optional<double> time_;
  std::optional<std::pair<double, Vector>> begin_;  // Time and pose at the start of the hand-over.
  int repeated_ = 0;
  bool is_first_ = true, is_ready_ = false;
  size_t motion_ = 0;
  std::optional<size_t> frame_;
  std::map<std::string, std::pair<float, float>> clocks_;  // Phase and amplitude.
  std::map<std::string, Vector> values_;
  std::vector<float> action_;
  Vector target_, sent_, handed_;
};

}  // namespace mjlab
