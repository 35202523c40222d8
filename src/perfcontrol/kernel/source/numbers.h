// What a pass over time computes with: the numbers of one path, or those of several paths side by side in a register.

#ifndef PERFCONTROL_NUMBERS_H_
#define PERFCONTROL_NUMBERS_H_

#include <cmath>
#include <cstddef>
#include <cstring>

namespace perfcontrol {

template <typename T>
struct Vectors {
  using Register __attribute__((vector_size(32))) = T;
  using Lanes __attribute__((vector_size(64))) = T;  // one register or two: each entry of a matrix serves twice as many
};

template <typename T>
using Register = typename Vectors<T>::Register;

template <typename T>
using Lanes = typename Vectors<T>::Lanes;

template <typename T>
constexpr size_t kWidth = sizeof(Register<T>) / sizeof(T);

// A number of `kLanes` paths.
template <typename T, bool kTogether>
struct Kind {
  using Number = T;
  static constexpr size_t kLanes = 1;
  // Vectors are padded with zeros to whole registers.
  static size_t Padded(size_t size) { return (size + kWidth<T> - 1) / kWidth<T> * kWidth<T>; }
};

template <typename T>
struct Kind<T, true> {
  using Number = Lanes<T>;
  static constexpr size_t kLanes = sizeof(Lanes<T>) / sizeof(T);
  static size_t Padded(size_t size) { return size; }
};

template <typename Number, typename Function>
inline Number ByLane(Number number, Function function) {
  if constexpr (std::is_floating_point_v<Number>) {
    return function(number);
  } else {
    for (size_t lane = 0; lane < sizeof(Number) / sizeof(number[0]); ++lane) number[lane] = function(number[lane]);
    return number;
  }
}

template <typename Number>
inline Number Root(Number number) {
  return ByLane(number, [](auto x) { return std::sqrt(x); });
}

// 1 / x where x > 0, else 0.
template <typename Number>
inline Number Inverse(Number number) {
  return ByLane(number, [](auto x) { return x > 0 ? 1 / x : 0 * x; });
}

template <typename Number>
inline Number IsPositive(Number number) {
  return ByLane(number, [](auto x) { return decltype(x)(x > 0); });
}

}  // namespace perfcontrol

#endif  // PERFCONTROL_NUMBERS_H_
