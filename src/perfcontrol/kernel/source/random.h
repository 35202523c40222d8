// The numbers of `pc.fast_key`, in C++: see random_keys.py for what they are and why streams do not meet.

#ifndef PERFCONTROL_RANDOM_H_
#define PERFCONTROL_RANDOM_H_

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>

namespace perfcontrol {

struct Stream {
  uint64_t a, b;

  static uint64_t Mix(uint64_t z) {
    z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9u;
    z = (z ^ (z >> 27)) * 0x94D049BB133111EBu;
    return z ^ (z >> 31);
  }
  Stream FoldIn(uint64_t number) const {
    constexpr uint64_t odd = 0x9E3779B97F4A7C15u;
    return {Mix(a + odd * (2 * number + 1)), Mix(b + odd)};
  }
  uint64_t Multiplier() const { return a | 1; }
  uint64_t First() const { return b + (a << 63); }
};

inline uint64_t Swapped(uint64_t x) { return (x >> 32) | (x << 32); }

inline uint32_t Word32(uint64_t counter, uint64_t k) {
  uint64_t x = counter * k;
  const uint64_t y = x, z = y + k;
  x = Swapped(x * x + y);
  x = Swapped(x * x + z);
  x = Swapped(x * x + y);
  return static_cast<uint32_t>((x * x + z) >> 32);
}

inline uint64_t Word64(uint64_t counter, uint64_t k) {
  uint64_t x = counter * k;
  const uint64_t y = x, z = y + k;
  x = Swapped(x * x + y);
  x = Swapped(x * x + z);
  x = Swapped(x * x + y);
  x = x * x + z;
  const uint64_t s = Swapped(x);
  return x ^ ((s * s + y) >> 32);
}

constexpr double kRoot3 = 1.7320508075688772;

// Uniform on [-√3, √3): as many of the high bits of a word as a number in [1, 2) has digits.
inline float Uniform(float, uint64_t counter, uint64_t k) {
  const float digits = static_cast<float>(static_cast<int32_t>(Word32(counter, k) >> 9)) * 0x1p-23f;
  return digits * static_cast<float>(2 * kRoot3) - static_cast<float>(kRoot3);
}

inline double Uniform(double, uint64_t counter, uint64_t k) {
  const double digits = static_cast<double>(static_cast<int64_t>(Word64(counter, k) >> 12)) * 0x1p-52;
  return digits * (2 * kRoot3) - kRoot3;
}

// Numbers `first`, `first` + 1, ... of each stream, side by side.
template <typename T, size_t kLanes>
void FillUniform(const std::array<Stream, kLanes>& streams, uint64_t first, size_t count, T* out) {
  uint64_t k[kLanes], start[kLanes];
  for (size_t lane = 0; lane < kLanes; ++lane) {
    k[lane] = streams[lane].Multiplier();
    start[lane] = streams[lane].First() + first;
  }
  if constexpr (kLanes == 1) {
#pragma omp simd
    for (size_t i = 0; i < count; ++i) out[i] = Uniform(T{}, start[0] + i, k[0]);
  } else {
    for (size_t i = 0; i < count; ++i) {
#pragma omp simd
      for (size_t lane = 0; lane < kLanes; ++lane) out[i * kLanes + lane] = Uniform(T{}, start[lane] + i, k[lane]);
    }
  }
}

// Signs, thirty-two from each word.
template <typename T, size_t kLanes>
void FillSigns(const std::array<Stream, kLanes>& streams, uint64_t first, size_t count, T* out) {
  for (size_t i = 0; i < count;) {
    const uint64_t place = first + i;
    const uint32_t low = static_cast<uint32_t>(place & 31);
    const size_t some = std::min<size_t>(32 - low, count - i);
    uint32_t words[kLanes];
    for (size_t lane = 0; lane < kLanes; ++lane) {
      words[lane] = Word32(streams[lane].First() + (place >> 5), streams[lane].Multiplier()) >> low;
    }
    for (size_t bit = 0; bit < some; ++bit) {
#pragma omp simd
      for (size_t lane = 0; lane < kLanes; ++lane) {
        out[(i + bit) * kLanes + lane] = static_cast<T>(static_cast<int32_t>((words[lane] >> bit) & 1) * 2 - 1);
      }
    }
    i += some;
  }
}

template <typename T, size_t kLanes>
void Fill(bool signs, const std::array<Stream, kLanes>& streams, uint64_t first, size_t count, T* out) {
  if (signs) {
    FillSigns<T, kLanes>(streams, first, count, out);
  } else {
    FillUniform<T, kLanes>(streams, first, count, out);
  }
}

}  // namespace perfcontrol

#endif  // PERFCONTROL_RANDOM_H_
