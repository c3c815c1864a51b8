// Lanes: MPM_LANES particles at once, so that a formula written once serves every instruction set.
//
// A unit that is compiled for an instruction set defines MPM_LANES: 4 with AVX2 and FMA, 8 with
// AVX-512 (F, DQ, BW, VL); else it is 1, mpm_vec is double, and everything below is plain C and
// libm. + - * / and comparisons work on mpm_vec as on double, also with a double on one side; a
// comparison gives an mpm_mask, masks combine with & and |. What one lane gets never depends on
// what is in the others.
//
// This is the only file that knows attributes, vector types and intrinsics.
#pragma once
#include <float.h>
#include <math.h>
#include <stdint.h>

#ifndef MPM_LANES
#define MPM_LANES 1
#endif

#define MPM_KERNEL static inline __attribute__((always_inline))
#define MPM_UNLIKELY(condition) __builtin_expect(!!(condition), 0)
#define MPM_ALIGNED _Alignas(64) // of an array that mpm_load_aligned reads

#if MPM_LANES == 1

typedef double mpm_vec;
typedef int mpm_mask;

MPM_KERNEL mpm_vec mpm_splat(double a) {
    return a;
}
MPM_KERNEL mpm_vec mpm_load(const double *from) {
    return *from;
}
MPM_KERNEL mpm_vec mpm_load_aligned(const double *from) {
    return *from;
}
MPM_KERNEL void mpm_store(double *to, mpm_vec a) {
    *to = a;
}
MPM_KERNEL void mpm_store_aligned(double *to, mpm_vec a) {
    *to = a;
}
MPM_KERNEL mpm_vec mpm_load_lanes_or(const double *from, int first, int last, double other) {
    return first <= 0 && 0 < last ? *from : other;
}
MPM_KERNEL void mpm_store_lanes(double *to, mpm_vec a, int first, int last) {
    if (first <= 0 && 0 < last) {
        *to = a;
    }
}
MPM_KERNEL void mpm_store_int32(int32_t *to, mpm_vec a) {
    *to = (int32_t)a;
}
MPM_KERNEL double mpm_lane(mpm_vec a, int lane) {
    (void)lane;
    return a;
}
MPM_KERNEL mpm_vec mpm_select(mpm_mask mask, mpm_vec a, mpm_vec b) {
    return mask ? a : b;
}
MPM_KERNEL mpm_mask mpm_not(mpm_mask mask) {
    return !mask;
}
MPM_KERNEL unsigned mpm_bits(mpm_mask mask) {
    return mask != 0;
}
MPM_KERNEL mpm_vec mpm_abs(mpm_vec a) {
    return fabs(a);
}
MPM_KERNEL mpm_vec mpm_sqrt(mpm_vec a) {
    return sqrt(a);
}
MPM_KERNEL mpm_vec mpm_trunc(mpm_vec a) {
    return trunc(a);
}
MPM_KERNEL mpm_vec mpm_floor(mpm_vec a) {
    return floor(a);
}
MPM_KERNEL double mpm_hsum(mpm_vec a) {
    return a;
}
MPM_KERNEL double mpm_hmin(mpm_vec a) {
    return a;
}
MPM_KERNEL double mpm_hmax(mpm_vec a) {
    return a;
}
MPM_KERNEL mpm_vec mpm_log(mpm_vec x) {
    return log(x);
}
MPM_KERNEL mpm_vec mpm_exp(mpm_vec x) {
    return exp(x);
}
MPM_KERNEL mpm_vec mpm_cbrt(mpm_vec x) {
    return cbrt(x);
}

#else // several lanes

#include <immintrin.h>

typedef double mpm_vec __attribute__((vector_size(8 * MPM_LANES)));
typedef __typeof__((mpm_vec){0} < (mpm_vec){0}) mpm_mask; // all bits of a lane, or none
typedef uint64_t mpm_word __attribute__((vector_size(8 * MPM_LANES)));

#if MPM_LANES == 4

#if !defined __AVX2__ || !defined __FMA__
#error "4 lanes need -march=x86-64-v3"
#endif

#define MPM_SIMD(operation) _mm256_##operation
MPM_KERNEL __m256i mpm_lane_range(int first, int last) {
    const __m256i lane = _mm256_set_epi64x(3, 2, 1, 0);
    return _mm256_andnot_si256(_mm256_cmpgt_epi64(_mm256_set1_epi64x(first), lane),
                               _mm256_cmpgt_epi64(_mm256_set1_epi64x(last), lane));
}
MPM_KERNEL mpm_vec mpm_load_lanes_or(const double *from, int first, int last, double other) {
    const __m256i range = mpm_lane_range(first, last);
    return _mm256_blendv_pd(_mm256_set1_pd(other), _mm256_maskload_pd(from, range),
                            _mm256_castsi256_pd(range));
}
MPM_KERNEL void mpm_store_lanes(double *to, mpm_vec a, int first, int last) {
    _mm256_maskstore_pd(to, mpm_lane_range(first, last), a);
}
MPM_KERNEL void mpm_store_int32(int32_t *to, mpm_vec a) {
    _mm_storeu_si128((__m128i *)(void *)to, _mm256_cvttpd_epi32(a));
}
MPM_KERNEL unsigned mpm_bits(mpm_mask mask) {
    return (unsigned)_mm256_movemask_pd((mpm_vec)mask);
}
MPM_KERNEL mpm_vec mpm_trunc(mpm_vec a) {
    return _mm256_round_pd(a, _MM_FROUND_TO_ZERO | _MM_FROUND_NO_EXC);
}
MPM_KERNEL mpm_vec mpm_floor(mpm_vec a) {
    return _mm256_round_pd(a, _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC);
}
// Of the lanes, by halves: the upper on the lower, until one is left.
#define MPM_FOLD(a, op) op(op(a[0], a[2]), op(a[1], a[3]))

#elif MPM_LANES == 8

#if !defined __AVX512F__ || !defined __AVX512DQ__
#error "8 lanes need -march=x86-64-v4"
#endif

#define MPM_SIMD(operation) _mm512_##operation
MPM_KERNEL __mmask8 mpm_lane_range(int first, int last) {
    first = first < 0 ? 0 : first > 8 ? 8 : first;
    last = last < 0 ? 0 : last > 8 ? 8 : last;
    return (__mmask8)((0xffu << first) & (0xffu >> (8 - last)));
}
MPM_KERNEL mpm_vec mpm_load_lanes_or(const double *from, int first, int last, double other) {
    return _mm512_mask_loadu_pd(_mm512_set1_pd(other), mpm_lane_range(first, last), from);
}
MPM_KERNEL void mpm_store_lanes(double *to, mpm_vec a, int first, int last) {
    _mm512_mask_storeu_pd(to, mpm_lane_range(first, last), a);
}
MPM_KERNEL void mpm_store_int32(int32_t *to, mpm_vec a) {
    _mm256_storeu_si256((__m256i *)(void *)to, _mm512_cvttpd_epi32(a));
}
MPM_KERNEL unsigned mpm_bits(mpm_mask mask) {
    return (unsigned)_mm512_movepi64_mask((__m512i)mask);
}
MPM_KERNEL mpm_vec mpm_trunc(mpm_vec a) {
    return _mm512_roundscale_pd(a, _MM_FROUND_TO_ZERO | _MM_FROUND_NO_EXC);
}
MPM_KERNEL mpm_vec mpm_floor(mpm_vec a) {
    return _mm512_roundscale_pd(a, _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC);
}
#define MPM_FOLD(a, op) op(op(op(a[0], a[4]), op(a[2], a[6])), op(op(a[1], a[5]), op(a[3], a[7])))

#else
#error "MPM_LANES is 1, 4 or 8"
#endif

MPM_KERNEL mpm_vec mpm_splat(double a) {
    return MPM_SIMD(set1_pd)(a);
}
MPM_KERNEL mpm_vec mpm_load(const double *from) {
    return MPM_SIMD(loadu_pd)(from);
}
MPM_KERNEL mpm_vec mpm_load_aligned(const double *from) {
    return MPM_SIMD(load_pd)(from);
}
MPM_KERNEL void mpm_store(double *to, mpm_vec a) {
    MPM_SIMD(storeu_pd)(to, a);
}
MPM_KERNEL void mpm_store_aligned(double *to, mpm_vec a) {
    MPM_SIMD(store_pd)(to, a);
}
MPM_KERNEL double mpm_lane(mpm_vec a, int lane) {
    return a[lane];
}
// Compilers make one blend of this.
MPM_KERNEL mpm_vec mpm_select(mpm_mask mask, mpm_vec a, mpm_vec b) {
    return (mpm_vec)((mask & (mpm_mask)a) | (~mask & (mpm_mask)b));
}
MPM_KERNEL mpm_mask mpm_not(mpm_mask mask) {
    return ~mask;
}
MPM_KERNEL mpm_vec mpm_abs(mpm_vec a) {
    return (mpm_vec)((mpm_word)a & INT64_MAX);
}
MPM_KERNEL mpm_vec mpm_sqrt(mpm_vec a) {
    return MPM_SIMD(sqrt_pd)(a);
}
#define MPM_ADD(a, b) ((a) + (b))
MPM_KERNEL double mpm_hsum(mpm_vec a) {
    return MPM_FOLD(a, MPM_ADD);
}
MPM_KERNEL double mpm_hmin(mpm_vec a) {
    return MPM_FOLD(a, fmin);
}
MPM_KERNEL double mpm_hmax(mpm_vec a) {
    return MPM_FOLD(a, fmax);
}

// y = f(x) where `lanes` has a bit: what the polynomials below leave to libm.
__attribute__((cold, noinline, unused)) static void mpm_by_lane(double (*f)(double), unsigned lanes,
                                                                const double *x, double *y) {
    for (int i = 0; i < MPM_LANES; i++) {
        if (lanes >> i & 1) {
            y[i] = f(x[i]);
        }
    }
}
MPM_KERNEL mpm_vec mpm_unless(mpm_mask in_range, mpm_vec y, double (*f)(double), mpm_vec x) {
    const unsigned out = ~mpm_bits(in_range) & ((1u << MPM_LANES) - 1);
    if (MPM_UNLIKELY(out)) {
        double from[MPM_LANES], to[MPM_LANES];
        mpm_store(from, x);
        mpm_store(to, y);
        mpm_by_lane(f, out, from, to);
        y = mpm_load(to);
    }
    return y;
}

#define MPM_2_52 0x1p52              // added to an integer below it, leaves that in the low bits
#define MPM_LN2_HIGH 0x1.62e42feep-1 // ln 2 in 32 bits: k times it is exact
#define MPM_LN2_LOW 0x1.a39ef35793c76p-33

// x = 2^k m with m in [sqrt(1/2), sqrt(2)); ln m = 2 atanh(s) with s = (m - 1)/(m + 1), f = m - 1:
// ln m = f - f^2/2 + s (f^2/2 + R(s^2)), which loses nothing near 1. R is minimax (Remez, 1.3e-18).
// At most 0.84 ulp off (measured, 4e6 arguments a range).
MPM_KERNEL mpm_vec mpm_log(mpm_vec x) {
    const mpm_mask in_range = (x >= DBL_MIN) & (x <= DBL_MAX);
    const uint64_t sqrt_half = 0x3fe6a09e00000000, one = 0x3ff0000000000000;
    const mpm_word shifted = (mpm_word)x + (one - sqrt_half);
    const mpm_vec k =
        (mpm_vec)((shifted >> 52) | (mpm_word)mpm_splat(MPM_2_52)) - (MPM_2_52 + 1023.0);
    const mpm_vec f = (mpm_vec)((shifted & 0xfffffffffffff) + sqrt_half) - 1.0;
    const mpm_vec s = f / (f + 2.0), z = s * s, half = 0.5 * f * f;
    mpm_vec R = 0.14796222597758338 * z + 0.1531402537190506;
    R = R * z + 0.18183565222132492;
    R = R * z + 0.2222219855780299;
    R = R * z + 0.2857142874251709;
    R = R * z + 0.39999999999414204;
    R = R * z + 0.6666666666666734;
    const mpm_vec y = k * MPM_LN2_HIGH - ((half - (s * (half + R * z) + k * MPM_LN2_LOW)) - f);
    return mpm_unless(in_range, y, log, x);
}

// x = k ln 2 + r with |r| <= ln(2)/2; e^r = 1 + r + r^2 (1/2 + r q(r)), q minimax (Remez, 5e-18).
// At most 1.0 ulp off (measured).
MPM_KERNEL mpm_vec mpm_exp(mpm_vec x) {
    const mpm_mask in_range = (x >= -708.0) & (x <= 709.0);
    const double round = 0x1.8p52; // added, leaves the nearest integer in the low bits
    const mpm_vec shifted = x * 1.4426950408889634 + round;
    const mpm_vec k = shifted - round;
    const mpm_vec r = (x - k * MPM_LN2_HIGH) - k * MPM_LN2_LOW;
    mpm_vec q = 2.497820272246884e-08 * r + 2.7625188948730094e-07;
    q = q * r + 2.755764144461859e-06;
    q = q * r + 2.4801508679485814e-05;
    q = q * r + 0.00019841269465584654;
    q = q * r + 0.0013888888926796587;
    q = q * r + 0.008333333333500293;
    q = q * r + 0.041666666666603965;
    q = q * r + 0.16666666666666433;
    q = q * r + 0.5;
    const mpm_vec y = 1.0 + (r + r * r * q);
    return mpm_unless(in_range, (mpm_vec)((mpm_word)y + ((mpm_word)shifted << 52)), exp, x);
}

static inline double mpm_cbrt_far(double x) { // libm's cbrt is off by up to 3.4 ulp
    return (double)cbrtl(x);
}
// y = x^(-1/3) from a third of the exponent, then by its Taylor series in 1 - x y^3 (0.1, 5e-5);
// c = x y^2 with one step of Newton. At most 0.74 ulp off (measured).
MPM_KERNEL mpm_vec mpm_cbrt(mpm_vec x) {
    const mpm_mask in_range = (x >= 0x1p-900) & (x <= 0x1p1000); // where no power leaves the range
    const mpm_vec high = (mpm_vec)(((mpm_word)x >> 32) | (mpm_word)mpm_splat(MPM_2_52)) - MPM_2_52;
    // In the low 32 bits the upper half of y; 0x553ee800 halves the error at both ends.
    mpm_vec y = (mpm_vec)((mpm_word)((MPM_2_52 + 0x553ee800) - high * (1.0 / 3)) << 32);
    mpm_vec e = 1.0 - x * y * (y * y);
    y += y * e * (1.0 / 3 + e * (2.0 / 9 + e * (14.0 / 81)));
    e = 1.0 - x * y * (y * y);
    y += y * e * (1.0 / 3 + e * (2.0 / 9));
    const mpm_vec y2 = y * y, c = x * y2;
    return mpm_unless(in_range, c + (x - c * c * c) * (y2 * (1.0 / 3)), mpm_cbrt_far, x);
}

#endif

MPM_KERNEL mpm_vec mpm_load_lanes(const double *from, int first, int last) {
    return mpm_load_lanes_or(from, first, last, 0);
}
MPM_KERNEL int mpm_any(mpm_mask mask) {
    return mpm_bits(mask) != 0;
}
MPM_KERNEL int mpm_all(mpm_mask mask) {
    return mpm_bits(mask) == (1u << MPM_LANES) - 1;
}
// The second where either is NaN.
MPM_KERNEL mpm_vec mpm_min(mpm_vec a, mpm_vec b) {
    return mpm_select(a < b, a, b);
}
MPM_KERNEL mpm_vec mpm_max(mpm_vec a, mpm_vec b) {
    return mpm_select(a > b, a, b);
}
