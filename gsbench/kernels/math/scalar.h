// The functions that math/ needs for its number type T, here for `float`; cpu/simd.h has them for SIMD vectors.
//
// math/ has the mathematics of one Gaussian and of one pixel: each function with its derivative, for all backends. T is
// `float` on CUDA, with one Gaussian or pixel per thread, or a SIMD vector of sixteen floats on the CPU. Derivatives
// (`vjp`) are vector-Jacobian products: from the gradients of a function's outputs, they return or add the gradients of
// its inputs. Names of gradients start with g_.
#pragma once

#include <cmath>

#include "thresholds.h"

#ifdef __CUDACC__
#define GSB_HD __host__ __device__
#else
#define GSB_HD __attribute__((always_inline))  // a vector that crosses a call goes through memory
#endif

// Small loops over the entries of a matrix are unrolled for AVX2 and AVX-512: a slice takes half the time with AVX2. For
// SSE, which holds four floats in a register, unrolling takes minutes to compile.
#if defined(__CUDACC__)
#define GSB_UNROLL _Pragma("unroll")
#elif (defined(__AVX512F__) || defined(__AVX2__)) && !defined(__clang__)
#define GSB_UNROLL _Pragma("GCC unroll 16")
#else
#define GSB_UNROLL
#endif

// The same sources are compiled once for each instruction set, each in its own namespace, so that the linker keeps them
// apart.
#ifndef GSB_ISA
#define GSB_ISA portable
#endif

namespace gsb {
inline namespace GSB_ISA {

GSB_HD inline float select(bool mask, float yes, float no) { return mask ? yes : no; }
GSB_HD inline float min(float a, float b) { return a < b ? a : b; }
GSB_HD inline float max(float a, float b) { return a > b ? a : b; }
GSB_HD inline float sqrt(float x) { return ::sqrtf(x); }
GSB_HD inline float exp2(float x) { return ::exp2f(x); }
GSB_HD inline float log2(float x) { return ::log2f(x); }
GSB_HD inline float round(float x) { return ::rintf(x); }

constexpr double LOG2_E = 1.4426950408889634;
constexpr double LN_2 = 0.6931471805599453;

template <class T>
GSB_HD inline T exp(T x) {
    return exp2(T(x * T(LOG2_E)));
}

// -x is bounded, because exp2 of a SIMD vector without AVX-512 is right for x < 129 alone: beyond, its exponent wraps.
template <class T>
GSB_HD inline T sigmoid(T x) {
    return T(1.0f) / (T(1.0f) + exp(min(T(0.0f) - x, T(EXPONENT_MAX))));
}

template <class T>
GSB_HD inline T clamp(T x, T low, T high) {
    return min(max(x, low), high);
}

template <class T>
struct Vec3 {
    T x, y, z;

    GSB_HD Vec3 operator+(const Vec3& o) const { return {x + o.x, y + o.y, z + o.z}; }
    GSB_HD Vec3 operator-(const Vec3& o) const { return {x - o.x, y - o.y, z - o.z}; }
    GSB_HD Vec3 operator*(T s) const { return {x * s, y * s, z * s}; }
    GSB_HD Vec3& operator+=(const Vec3& o) { return *this = *this + o; }
};

template <class T>
GSB_HD inline T dot(const Vec3<T>& a, const Vec3<T>& b) {
    return a.x * b.x + a.y * b.y + a.z * b.z;
}

template <class T>
GSB_HD inline Vec3<T> cross(const Vec3<T>& a, const Vec3<T>& b) {
    return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

}  // namespace GSB_ISA
}  // namespace gsb
