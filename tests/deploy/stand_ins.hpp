// Stand-ins for the libraries of the README's C++: declarations, enough to check its syntax and types.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <memory>
#include <vector>

// ONNX Runtime.

enum { OrtArenaAllocator, OrtMemTypeDefault };

namespace Ort {
struct Env {};
struct RunOptions {
  RunOptions(std::nullptr_t);
};
struct SessionOptions {
  SessionOptions& SetIntraOpNumThreads(int);
};
struct MemoryInfo {
  static MemoryInfo CreateCpu(int allocator, int type);
};
struct TensorInfo {
  size_t GetElementCount() const;
};
struct Value {
  template <typename T>
  static Value CreateTensor(const MemoryInfo&, T*, size_t, const int64_t*, size_t);
  template <typename T>
  const T* GetTensorData() const;
  TensorInfo GetTensorTypeAndShapeInfo() const;
};
struct Session {
  Session(Env&, const char*, const SessionOptions&);
  std::vector<Value> Run(const RunOptions&, const char* const*, const Value*, size_t,
                         const char* const*, size_t);
};
}  // namespace Ort

// ROS 2.

#define RCLCPP_ERROR_ONCE(logger, ...) ((void)(logger), (void)std::printf(__VA_ARGS__))

namespace rclcpp {
struct Time {
  double seconds() const;
};
struct Duration {
  double seconds() const;
};
struct Node {
  int get_logger() const;
};
}  // namespace rclcpp

struct Interface {
  double get_value() const;
  void set_value(double);
};

struct Imu {
  std::array<double, 4> get_orientation();
  std::array<double, 3> get_angular_velocity();
};

struct Twist {
  struct {
    double x, y, z;
  } linear, angular;
};

struct TwistBuffer {
  Twist* readFromRT();
};

namespace controller_interface {
enum class return_type { OK };
struct ControllerInterface {
  virtual ~ControllerInterface() = default;
  virtual return_type update(const rclcpp::Time&, const rclcpp::Duration&) = 0;
  std::shared_ptr<rclcpp::Node> get_node() const;
  std::vector<Interface> state_interfaces_, command_interfaces_;
};
}  // namespace controller_interface
