// Run the policy of this folder on a robot. C++17, nlohmann/json.hpp (Debian: nlohmann-json3-dev).
//
//     mjlab::Policy policy(".", network);       // README.md has a network by onnxruntime
//     while (!policy.is_ready())                // from a standing pose to the first of the policy
//       send(policy.hand_over(measure()));      // then wait until the period is over
//     policy.reset(0, measure());
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

/// Observation term: settings, and its place in the inputs of the network.
struct Term {
  std::string key;  // <input>/<name>
  Formula formula;
  std::vector<std::string> inputs;
  std::vector<size_t> columns;  // Empty: all.
  Vector offset, scale;         // Empty: none. One number, or one a component.
  double factor = 1.0;
  std::array<double, 2> clip = {};
  json params;
  size_t size = 0, total = 0;  // Numbers of one value, and with its history.
  // Number of the input, and the term's place there: blocks of `length` numbers, `stride` apart.
  size_t index = 0, begin = 0, length = 0, stride = 0;
};

[[noreturn]] inline void fail(const std::string& text) { throw std::invalid_argument(text); }

/// Return lists and numbers as a vector, and null as an empty one.
inline Vector numbers(const json& value) {
  if (value.is_null()) return {};
  return value.is_array() ? value.get<Vector>() : Vector{value.get<double>()};
}

/// Return the bounds of a clip; null: none.
inline std::array<double, 2> bounds(const json& clip) {
  std::array<double, 2> found = {-INFINITY, INFINITY};
  for (size_t k = 0; k < 2 && !clip.is_null(); ++k)
    if (!clip[k].is_null()) found[k] = clip[k];
  return found;
}

/// Return component `k`; vectors of one number have it for all components.
inline double at(const Vector& x, size_t k) { return x.size() == 1 ? x[0] : x.at(k); }

inline double norm(const Vector& x) {
  return std::sqrt(std::inner_product(x.begin(), x.end(), x.begin(), 0.0));
}

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

/// Return a - b of places.
inline Vector difference(const Vector& a, const Vector& b) {
  return {a.at(0) - b.at(0), a.at(1) - b.at(1), a.at(2) - b.at(2)};
}

/// Return factor * x - offset of the chosen components.
inline Vector reading(const std::vector<Vector>& inputs, const Term& term) {
  Vector x = term.columns.empty() ? inputs.at(0) : Vector{};
  for (size_t column : term.columns) x.push_back(inputs.at(0).at(column));
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

/// Return two columns of the relative rotation matrix, row by row.
inline Vector orientation_in_frame(const std::vector<Vector>& inputs, const Term&) {
  const Matrix of = rotation(inputs.at(0)), frame = rotation(inputs.at(1));
  const Vector x = turned_back(frame, {of[0][0], of[1][0], of[2][0]});
  const Vector y = turned_back(frame, {of[0][1], of[1][1], of[2][1]});
  return {x[0], y[0], x[1], y[1], x[2], y[2]};
}

/// Return translation and rotation vector from a pose to the commanded pose.
inline Vector pose_error(const std::vector<Vector>& inputs, const Term&) {
  const Vector &q = inputs.at(1), &goal = inputs.at(2), move = difference(goal, inputs.at(0));
  const double w = q.at(0), x = q.at(1), y = q.at(2), z = q.at(3);
  const double a = goal.at(3), b = goal.at(4), c = goal.at(5), d = goal.at(6);
  // Product of the goal's quaternion with the conjugate of q.
  const double cosine = w * a + x * b + y * c + z * d, sign = cosine < 0 ? -1.0 : 1.0;
  const Vector axis = {-x * a + w * b - z * c + y * d, -y * a + z * b + w * c - x * d,
                       -z * a - y * b + x * c + w * d};
  const double sine = norm(axis), angle = 2 * std::atan2(sine, std::abs(cosine));
  const double ratio = sign * (sine > 1e-9 ? angle / sine : 2.0);
  return {move[0], move[1], move[2], ratio * axis[0], ratio * axis[1], ratio * axis[2]};
}

/// Formulas by kind. A term of your own, before the policy is made:
/// `mjlab::TERMS["my_package.mdp:wheel_speed"] = [](const auto& inputs, const auto& term) { ... };`
inline std::map<std::string, Formula> TERMS = {
    {"reading", reading},
    {"command", reading},
    {"last_action", reading},
    {"cos_sin", cos_sin},
    {"gravity",
     [](const auto& x, const Term&) { return turned_back(rotation(x.at(0)), {0.0, 0.0, -1.0}); }},
    {"vector_in_frame",
     [](const auto& x, const Term&) { return turned_back(rotation(x.at(1)), x.at(0)); }},
    {"position_in_frame",
     [](const auto& x, const Term&) {
       return turned_back(rotation(x.at(2)), difference(x.at(0), x.at(1)));
     }},
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
  if (!file) fail(path.string() + ": not found.");
  const std::string bytes{std::istreambuf_iterator<char>(file), {}};
  const auto number = [&bytes](size_t place, size_t count) {
    uint64_t value = 0;
    for (size_t k = count; k-- > 0;) value = 256 * value + uint8_t(bytes.at(place + k));
    return value;
  };
  std::map<std::string, Array> arrays;
  for (size_t next = 0; number(next, 4) == 0x04034b50;) {  // Header of a member, of 30 bytes.
    const size_t member = next, name_length = number(member + 26, 2);
    const size_t extra = member + 30 + name_length, begin = extra + number(member + 28, 2);
    if (number(member + 8, 2) != 0) fail(path.string() + ": compressed; use numpy.savez.");
    const size_t size = number(member + 18, 4);
    next = begin + (size == 0xffffffff ? number(extra + 12, 8) : size);
    // Header of an array: magic string, version, length and text.
    const size_t text = begin + (bytes.at(begin + 6) == 1 ? 10 : 12);
    const size_t data = text + number(begin + 8, text - begin - 8);
    const std::string header = bytes.substr(text, data - text);
    if (header.find("'<f4'") == std::string::npos || header.find("True") != std::string::npos)
      continue;  // Other numbers, or in the order of Fortran.
    Array& array = arrays[bytes.substr(member + 30, name_length - std::strlen(".npy"))];
    array.rows = std::stoul(header.substr(header.find('(') + 1));
    array.data.resize((next - data) / sizeof(float));
    std::memcpy(array.data.data(), &bytes.at(data), next - data);
  }
  return arrays;
}

/// Path of a motion's anchor: places (T, 3) and quaternions (T, 4).
struct Path {
  std::vector<Vector> places, turns;

  /// Turn and move it over the ground: frame `t` gets the heading of `turn`, and the place.
  void align(size_t t, const Vector& place, const Vector& turn) {
    const auto crossed = [](const Vector& q) { return Vector{-q[3], -q[2], q[1], q[0]}; };
    const auto dot = [&turn](const Vector& q) {
      return std::inner_product(q.begin(), q.end(), turn.begin(), 0.0);
    };
    const double half = std::atan2(dot(crossed(turns.at(t))), dot(turns.at(t)));
    const double cosine = std::cos(half), sine = std::sin(half);
    const Matrix back = rotation({cosine, 0.0, 0.0, -sine});
    const Vector from = turned_back(back, places.at(t));
    for (Vector& p : places) {
      p = turned_back(back, p);
      for (size_t k = 0; k < 2; ++k) p[k] += place.at(k) - from[k];
    }
    for (Vector& q : turns) {
      const Vector other = crossed(q);
      for (size_t k = 0; k < 4; ++k) q[k] = cosine * q[k] + sine * other[k];
    }
  }
};

/// Policy with its contract, memory, clocks and limits. After a measurement that is stale, not
/// finite or beyond the limits, all steps damp until `reset`.
class Policy {
 public:
  /// Read contract.json of a folder. Without limits, targets are those of the policy.
  Policy(const std::filesystem::path& folder, Network network, bool limits = true)
      : network_(std::move(network)), is_limited_(limits) {
    std::ifstream file(folder / "contract.json");
    if (!file) fail((folder / "contract.json").string() + ": not found.");
    contract_ = json::parse(file);
    if (contract_["schema"] != "mjlab-contract" || contract_["version"] != 1)
      fail("contract.json: expected schema mjlab-contract, version 1.");
    period_ = contract_["rates"]["step_dt"];
    for (const json& joint : contract_["joints"]) {
      names_.push_back(joint["name"]);
      kp_.push_back(joint["kp"]);
      kd_.push_back(joint["kd"]);
      default_.push_back(joint["default_pos"]);
    }
    for (const auto& [name, value] : contract_["limits"].items())
      if (!value.is_string()) limits_[name] = numbers(value);
    const json& policy = contract_["policy"];
    if (!policy["clip"].is_null()) clip_ = policy["clip"];
    action_.resize(policy["size"]);
    outputs_ = {policy["output"]};
    for (const json& entry : policy["inputs"]) add_input(entry);
    for (const json& observation : contract_["observations"])
      for (const json& term : observation["terms"]) terms_.push_back(make_term(observation, term));
    for (const json& action : contract_["actions"]) actions_.push_back(make_action(action));
    for (const json& entry : contract_["commands"])
      commands_[entry["kind"]].emplace_back("command/" + entry["name"].get<std::string>(), entry);
    for (const auto& [key, entry] : commands_["motion"])
      motion_ = read_npz(folder / entry["file"].get<std::string>());
    reset();
  }

  /// Clear memory, clocks and faults. A motion begins where the robot is, if it is measured.
  void reset(size_t motion = 0, const Values& measurements = {}) {
    sent_ = std::exchange(handed_, {});  // The first jump is that from the last of the hand-over.
    episode_ = Episode{};
    std::fill(action_.begin(), action_.end(), 0.0f);
    for (size_t k : memory_) std::fill(inputs_[k].data.begin(), inputs_[k].data.end(), 0.0f);
    for (const auto& [key, entry] : commands_["motion"]) {
      begin_motion(entry, motion, measurements);
    }
    for (const auto& [key, entry] : commands_["gait_clock"])
      episode_.clocks[key].first = entry["start"];
  }

  /// Return the motor commands of one period.
  ///
  /// `command` is that of the only given command; several are entries `command/<name>` of the
  /// measurements. Raises std::invalid_argument if numbers are missing.
  Targets step(const Values& measurements, const Vector& command = {}) {
    Values values = checked(measurements);
    add_commands(values, command);
    values["last_action"] = Vector(action_.begin(), action_.end());
    for (const Term& term : terms_) observe(term, values);
    episode_.is_first = false;
    infer();
    const Vector& q = values["joint_pos"];
    return episode_.reason.empty() ? targets(q) : damp(q);
  }

  /// Let the network answer its inputs, and keep its memory.
  void infer() {
    const std::vector<std::vector<float>> answers = network_(outputs_, inputs_);
    if (answers.size() != outputs_.size() || answers[0].size() != action_.size())
      fail("Network: expected " + std::to_string(action_.size()) + " actions, then the memory.");
    bool finite = is_finite(answers[0]);
    for (const Input& input : inputs_) finite = finite && is_finite(input.data);
    if (is_limited_ && !finite && episode_.reason.empty())
      episode_.reason = "a command or the answer of the policy is not finite";
    for (size_t k = 0; k < memory_.size(); ++k) inputs_[memory_[k]].data = answers[k + 1];
    for (size_t k = 0; k < action_.size(); ++k)
      action_[k] = static_cast<float>(std::clamp<double>(answers[0][k], -clip_, clip_));
  }

  /// Move to the first pose of the policy in `seconds`; ready then, if each joint is within
  /// `tolerance` (rad, m).
  Targets hand_over(const Values& measurements, double seconds = 2.0, double tolerance = 0.3) {
    handed_.clear();
    const Values values = checked(measurements);
    const Vector& q = found(values, "joint_pos");
    if (!episode_.reason.empty()) return damp(q);
    if (!episode_.begin) episode_.begin = {measurements.time, q};
    const auto& [start, pose] = *episode_.begin;
    const double share = std::min((measurements.time - start) / seconds, 1.0);
    Targets result = commanded(pose);
    double farthest = 0.0;
    for (size_t k = 0; k < q.size(); ++k) {
      result.position[k] += share * (default_[k] - pose[k]);
      farthest = std::max(farthest, std::abs(q[k] - default_[k]));
    }
    episode_.is_ready = share == 1.0 && farthest < tolerance;
    for (const Action& action : actions_)
      for (size_t joint : action.index) handed_.push_back((result.*action.field)[joint]);
    return result;
  }

  /// Return commands that only brake: no stiffness, targets at the measured positions.
  Targets damp(Vector q) const {
    for (size_t k = 0; k < q.size(); ++k)
      if (!std::isfinite(q[k])) q[k] = default_[k];
    const Vector zero(names_.size(), 0.0);
    return {names_, std::move(q), zero, zero, zero, kd_, period_, true, episode_.reason};
  }

  /// Return commands of joint positions, with the gains of the contract.
  Targets commanded(Vector position) const {
    const Vector zero(names_.size(), 0.0);
    return {names_, std::move(position), zero, zero, kp_, kd_, period_, false, ""};
  }

  const json& contract() const { return contract_; }
  const std::vector<std::string>& names() const { return names_; }
  double period() const { return period_; }
  bool is_ready() const { return episode_.is_ready; }
  // Of the last step: values of the terms before clip and scale, by `<input>/<term>`; inputs and
  // answer of the network; targets before the limits, in order of the actions.
  const std::map<std::string, Vector>& values() const { return values_; }
  const std::vector<Input>& inputs() const { return inputs_; }
  const std::vector<float>& action() const { return action_; }
  const Vector& target() const { return target_; }

 private:
  struct Action {
    Vector scale, offset, open, closed;  // Of a gripper open and closed, else scale and offset.
    size_t start = 0;                    // In the action vector.
    bool is_relative = false;            // Targets are relative to the measured positions.
    Vector Targets::*field = nullptr;
    std::vector<size_t> index;  // Joints.
    std::vector<std::array<double, 2>> clip;
  };

  struct Episode {
    std::string reason;  // Of damping.
    std::optional<double> time;
    int repeated = 0;  // Measurements.
    bool is_first = true, is_ready = false;
    std::optional<std::pair<double, Vector>> begin;  // Time and pose at the start of the hand-over.
    std::map<std::string, std::pair<float, float>> clocks;  // Phase and amplitude.
    size_t frame = 0, last = 0;  // Of the motion.
    Path path;
  };

  static size_t product(const std::vector<size_t>& shape, size_t first = 0) {
    return std::accumulate(shape.begin() + static_cast<std::ptrdiff_t>(first), shape.end(),
                           size_t{1}, std::multiplies<size_t>());
  }

  void add_input(const json& entry) {
    if (entry["kind"] == "memory") {
      memory_.push_back(inputs_.size());
      outputs_.push_back(entry["output"]);
    }
    const std::vector<size_t> shape = entry["shape"];
    inputs_.push_back({entry["name"], entry["shape"], std::vector<float>(product(shape))});
  }

  Term make_term(const json& observation, const json& entry) const {
    Term term;
    const std::string input = observation["input"], kind = entry["kind"];
    term.key = input + "/" + entry["name"].get<std::string>();
    const auto known = TERMS.find(TERMS.count(kind) ? kind : entry["function"].get<std::string>());
    if (known == TERMS.end())
      fail("Term '" + term.key + "': add " + entry["function"].dump() + " to mjlab::TERMS.");
    term.formula = known->second;
    term.inputs = entry["inputs"].get<std::vector<std::string>>();
    if (kind == "last_action") term.inputs = {"last_action"};
    if (!entry["columns"].is_null()) term.columns = entry["columns"].get<std::vector<size_t>>();
    term.offset = numbers(entry["offset"]);
    term.scale = numbers(entry["scale"]);
    if (!entry["factor"].is_null()) term.factor = entry["factor"];
    term.clip = bounds(entry["clip"]);
    term.params = entry["params"];
    term.size = entry["size"];
    const size_t length = entry["history"]["length"];
    term.total = term.size * std::max<size_t>(length, 1);
    while (inputs_.at(term.index).name != input) ++term.index;
    // Terms lie side by side along an axis of the input; `inner` numbers follow each index of it.
    const std::vector<size_t> shape = observation["shape"];
    const size_t axis = observation["axis"], inner = product(shape, axis + 1);
    const size_t start = entry["start"], stop = entry["stop"];
    term.begin = start * inner;
    term.length = (stop - start) * inner;
    term.stride = shape.at(axis) * inner;
    return term;
  }

  Action make_action(const json& entry) const {
    const std::string name = entry["name"], kind = entry["kind"];
    if (kind == "custom") fail("Action '" + name + "': compute its targets here.");
    const auto get = [&entry](const char* key) { return entry.value(key, json()); };
    Action action{numbers(get("scale")), numbers(get("offset")), numbers(get("open")),
                  numbers(get("closed")), entry["start"], kind == "relative_joint_position",
                  &Targets::position, {}, {}};
    if (kind == "joint_velocity") action.field = &Targets::velocity;
    if (kind == "joint_effort") action.field = &Targets::effort;
    const json clip = get("clip");
    for (const std::string joint : entry["joints"]) {
      const auto place = std::find(names_.begin(), names_.end(), joint);
      if (place == names_.end()) fail("Action '" + name + "': unknown joint '" + joint + "'.");
      action.clip.push_back(bounds(clip.is_null() ? clip : clip.at(action.index.size())));
      action.index.push_back(static_cast<size_t>(place - names_.begin()));
    }
    return action;
  }

  static const Vector& found(const Values& values, const std::string& name) {
    const auto place = values.find(name);
    if (place == values.end()) fail("Missing measurement or command '" + name + "'.");
    return place->second;
  }

  static void check_size(const std::string& name, const Vector& value, size_t size) {
    if (value.size() != size)
      fail("'" + name + "': expected " + std::to_string(size) + " numbers, got " +
           std::to_string(value.size()) + ".");
  }

  /// Return the values; set the reason if they are stale, not finite, or beyond the limits.
  Values checked(const Values& values) {
    bool are_unit = true;
    for (const json& entry : contract_["measurements"]) {
      const auto given = values.find(entry["name"]);
      if (given == values.end()) continue;
      check_size(given->first, given->second, entry["size"]);
      const bool is_turn = entry.value("is_quaternion", false);
      are_unit = are_unit && !(is_turn && std::abs(norm(given->second) - 1) > 0.05);
    }
    const std::optional<double> last = std::exchange(episode_.time, values.time);
    std::string& reason = episode_.reason;
    if (!reason.empty() || !is_limited_) return values;
    const double gap = last ? values.time - *last : period_;
    episode_.repeated = gap <= 0 ? episode_.repeated + 1 : 0;
    const double age = std::max(gap, episode_.repeated * period_);
    bool finite = std::isfinite(values.time), is_fast = false;
    for (const auto& [name, value] : values) finite = finite && is_finite(value);
    const Vector& speed = found(values, "joint_vel");
    for (size_t k = 0; k < speed.size(); ++k)
      is_fast = is_fast || std::abs(speed[k]) > at(limits_["joint_speed"], k);
    const json& from = contract_["limits"]["tilt_from"];
    const bool has_tilt = !from.is_null() && !limits_["tilt"].empty();
    // A comparison with NaN is false.
    if (!(age <= limits_["max_age"][0]))
      reason = "no new measurement for " + std::to_string(age) + " s";
    else if (!finite)
      reason = "a measurement is not finite";
    else if (is_fast)
      reason = "a joint is faster than limits.joint_speed";
    else if (!are_unit)
      reason = "a quaternion is not of length 1";
    else if (has_tilt && rotation(found(values, from))[2][2] < std::cos(limits_["tilt"][0]))
      reason = "the robot is tilted by more than limits.tilt";
    return values;
  }

  /// Add given commands, gait clocks and motions to `values`.
  void add_commands(Values& values, const Vector& command) {
    if (!command.empty() && commands_["given"].size() > 1)
      fail("Command: several are given; add each to the measurements, as command/<name>.");
    for (const auto& [key, entry] : commands_["given"]) {
      if (!command.empty()) values[key] = command;
      check_size(key, found(values, key), entry["size"]);
    }
    for (const auto& [key, entry] : commands_["gait_clock"]) values[key] = tick(key, entry, values);
    for (const auto& [key, entry] : commands_["motion"]) play(key, values);
  }

  /// Return (A sin, A cos) of a gait clock, after advancing it; float, as in training.
  Vector tick(const std::string& key, const json& entry, const Values& values) {
    auto& [phase, fade] = episode_.clocks[key];
    const double fade_s = entry["fade_s"];
    bool stands = false;
    if (!entry["velocity_command"].is_null()) {
      const Vector& v = found(values, "command/" + entry["velocity_command"].get<std::string>());
      const double speed = std::hypot(v.at(0), v.at(1)) + std::abs(v.at(2));
      stands = speed < entry["standing_threshold"].get<double>();
    }
    if (!episode_.is_first) {
      const float advance = static_cast<float>(entry["frequency"].get<double>() * period_);
      const float change = static_cast<float>(stands ? -period_ : period_);
      phase = std::fmod(phase + advance, 1.0f);
      fade = std::clamp(fade + change / static_cast<float>(fade_s > 0 ? fade_s : 1.0), 0.0f, 1.0f);
    }
    const float amplitude = fade_s > 0 ? fade : (stands ? 0.0f : 1.0f);
    const float angle = phase * 6.28318530717958648f;
    return {amplitude * std::sin(angle), amplitude * std::cos(angle)};
  }

  /// Go to the frame before the first observed one; turn and move the motion to the robot.
  void begin_motion(const json& entry, size_t motion, const Values& measurements) {
    const json& part = entry["motions"].at(motion);
    const size_t start = part["start"], length = part["length"], offset = entry["start_frame"];
    const size_t t = episode_.frame = start + offset - 1, body = entry["anchor_index"];
    episode_.last = start + length - 1;
    default_ = motion_.at("joint_pos").row(t, 0, names_.size());
    Path& path = episode_.path;
    for (size_t k = 0; k < motion_.at("body_pos_w").rows; ++k) {
      path.places.push_back(motion_.at("body_pos_w").row(k, 3 * body, 3));
      path.turns.push_back(motion_.at("body_quat_w").row(k, 4 * body, 4));
    }
    const auto measured = [&](const char* name, const Vector& otherwise) {
      const auto value = measurements.find(entry.value(name, ""));
      return value == measurements.end() ? otherwise : value->second;
    };
    path.align(t, measured("anchor_pos", path.places[t]), measured("anchor_quat", path.turns[t]));
  }

  /// Add the next frame of the motion; its last frame is held.
  void play(const std::string& key, Values& values) {
    const size_t t = episode_.frame = std::min(episode_.frame + 1, episode_.last);
    Vector& reference = values[key] = motion_.at("joint_pos").row(t, 0, names_.size());
    const Vector speed = motion_.at("joint_vel").row(t, 0, names_.size());
    reference.insert(reference.end(), speed.begin(), speed.end());
    values[key + "/anchor_pos"] = episode_.path.places[t];
    values[key + "/anchor_quat"] = episode_.path.turns[t];
    for (Input& input : inputs_)
      if (input.name == "time_step") input.data[0] = static_cast<float>(t);
  }

  /// Compute a term, and write it with its history into the network input, oldest value first.
  void observe(const Term& term, const Values& values) {
    std::vector<Vector> inputs;
    for (const std::string& name : term.inputs) inputs.push_back(found(values, name));
    const Vector& value = values_[term.key] = term.formula(inputs, term);
    check_size(term.key, value, term.size);
    float* slot = &inputs_[term.index].data[term.begin];
    // A history is one block. The first value of an episode fills it.
    if (term.total > term.size) std::copy(slot + term.size, slot + term.total, slot);
    for (size_t k = episode_.is_first ? 0 : term.total - term.size; k < term.total; ++k) {
      const double clipped = std::clamp(value[k % term.size], term.clip[0], term.clip[1]);
      const double scale = term.scale.empty() ? 1.0 : at(term.scale, k % term.size);
      slot[k / term.length * term.stride + k % term.length] = static_cast<float>(clipped * scale);
    }
  }

  /// Return the motor commands of the last action at measured positions, within the limits.
  Targets targets(const Vector& joint_pos) {
    target_.clear();
    for (const Action& action : actions_)
      for (size_t k = 0; k < action.index.size(); ++k) {
        const bool is_gripper = !action.open.empty();
        const double raw = action_.at(action.start + (is_gripper ? 0 : k));
        const double target = is_gripper ? (raw < 0 ? action.closed : action.open).at(k)
                                         : raw * at(action.scale, k) + at(action.offset, k);
        target_.push_back(std::clamp(target, action.clip[k][0], action.clip[k][1]) +
                          (action.is_relative ? joint_pos.at(action.index[k]) : 0.0));
      }
    Vector sent = target_;
    for (size_t k = 0; is_limited_ && k < sent.size(); ++k) {
      sent[k] = std::clamp(sent[k], limits_["target_low"].at(k), limits_["target_high"].at(k));
      const double jump = limits_["target_step"].at(k), last = sent_.empty() ? sent[k] : sent_[k];
      sent[k] = std::clamp(sent[k], last - jump, last + jump);
    }
    sent_ = sent;
    Targets result = commanded(default_);
    size_t next = 0;
    for (const Action& action : actions_)
      for (size_t joint : action.index) (result.*action.field)[joint] = sent[next++];
    return result;
  }

  json contract_;
  Network network_;
  bool is_limited_;
  double period_ = 0.0, clip_ = INFINITY;
  std::vector<std::string> names_, outputs_;
  Vector kp_, kd_, default_;
  std::map<std::string, Vector> limits_;
  std::vector<Input> inputs_;
  std::vector<size_t> memory_;  // Inputs that are fed back.
  std::vector<Term> terms_;
  std::vector<Action> actions_;
  std::map<std::string, std::vector<std::pair<std::string, json>>> commands_;  // By kind.
  std::map<std::string, Array> motion_;
  Episode episode_;
  std::map<std::string, Vector> values_;
  std::vector<float> action_;
  Vector target_, sent_, handed_;
};

}  // namespace mjlab
