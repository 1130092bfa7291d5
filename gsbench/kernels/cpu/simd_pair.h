// A SIMD vector that is a pair of halves: registers, or pairs of halves again.
#pragma once

#include <cstdint>

#include "../math/scalar.h"

namespace gsb {
inline namespace GSB_ISA {

template <class Half>
struct PairMask {
    static constexpr int size = 2 * Half::size;
    Half lo, hi;

    GSB_HD friend PairMask operator&(PairMask a, PairMask b) { return {a.lo & b.lo, a.hi & b.hi}; }
    GSB_HD friend PairMask operator|(PairMask a, PairMask b) { return {a.lo | b.lo, a.hi | b.hi}; }
    GSB_HD friend PairMask operator!(PairMask a) { return {!a.lo, !a.hi}; }
    GSB_HD friend uint32_t bits(PairMask a) { return bits(a.lo) | bits(a.hi) << Half::size; }
};

template <class Half>
struct Pair {
    using Number = typename Half::Number;
    using Mask = PairMask<typename Half::Mask>;
    static constexpr int size = 2 * Half::size;
    Half lo, hi;

    Pair() = default;
    GSB_HD Pair(Half lo, Half hi) : lo(lo), hi(hi) {}
    GSB_HD Pair(Number s) : lo(s), hi(s) {}

    GSB_HD static Pair load(const Number* p) { return {Half::load(p), Half::load(p + Half::size)}; }
    GSB_HD void store(Number* p) const {
        lo.store(p);
        hi.store(p + Half::size);
    }
    GSB_HD static Pair gather(const Number* p, int stride) {
        return {Half::gather(p, stride), Half::gather(p + Half::size * stride, stride)};
    }
    GSB_HD void scatter(Number* p, int stride) const {
        lo.scatter(p, stride);
        hi.scatter(p + Half::size * stride, stride);
    }

    GSB_HD friend Pair operator+(Pair a, Pair b) { return {a.lo + b.lo, a.hi + b.hi}; }
    GSB_HD friend Pair operator-(Pair a, Pair b) { return {a.lo - b.lo, a.hi - b.hi}; }
    GSB_HD friend Pair operator/(Pair a, Pair b) { return {a.lo / b.lo, a.hi / b.hi}; }
    GSB_HD friend Pair times(Pair a, Pair b) { return {times(a.lo, b.lo), times(a.hi, b.hi)}; }
    GSB_HD friend Pair times_plus(Pair a, Pair b, Pair c) {  // a b + c
        return {times_plus(a.lo, b.lo, c.lo), times_plus(a.hi, b.hi, c.hi)};
    }
    GSB_HD friend Pair times_minus(Pair a, Pair b, Pair c) {  // a b - c
        return {times_minus(a.lo, b.lo, c.lo), times_minus(a.hi, b.hi, c.hi)};
    }
    GSB_HD friend Pair minus_times(Pair c, Pair a, Pair b) {  // c - a b
        return {minus_times(c.lo, a.lo, b.lo), minus_times(c.hi, a.hi, b.hi)};
    }
    GSB_HD friend Mask operator<(Pair a, Pair b) { return {a.lo < b.lo, a.hi < b.hi}; }
    GSB_HD friend Mask operator<=(Pair a, Pair b) { return {a.lo <= b.lo, a.hi <= b.hi}; }
    GSB_HD friend Mask operator==(Pair a, Pair b) { return {a.lo == b.lo, a.hi == b.hi}; }
    GSB_HD friend Pair select(Mask m, Pair yes, Pair no) {
        return {select(m.lo, yes.lo, no.lo), select(m.hi, yes.hi, no.hi)};
    }
    GSB_HD friend Pair min(Pair a, Pair b) { return {min(a.lo, b.lo), min(a.hi, b.hi)}; }
    GSB_HD friend Pair max(Pair a, Pair b) { return {max(a.lo, b.lo), max(a.hi, b.hi)}; }
    GSB_HD friend Pair sqrt(Pair a) { return {sqrt(a.lo), sqrt(a.hi)}; }
    GSB_HD friend Pair exp2(Pair x) { return {exp2(x.lo), exp2(x.hi)}; }
    GSB_HD friend void split(Pair x, Pair& mantissa, Pair& exponent) {
        split(x.lo, mantissa.lo, exponent.lo);
        split(x.hi, mantissa.hi, exponent.hi);
    }
};

}  // namespace GSB_ISA
}  // namespace gsb
