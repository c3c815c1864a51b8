// Lanes: MPM_LANES particles at once, so that a formula written once serves every instruction set.
//
// A unit that is compiled for an instruction set defines MPM_LANES: 4 with AVX2 and FMA, 8 with
// AVX-512 (F, DQ, BW, VL); else it is 1, mpm_vec is double, and everything below is plain C and
// libm. + - * / and comparisons work on mpm_vec as on double, also with a double on one side; a
// comparison gives an mpm_mask, masks combine with & and |. What one lane gets never depends on
// what is in the others.
//
// This is the only file with intrinsics, assembly and definitions of vector types.
#pragma once
#include <float.h>
#include <math.h>
#include <stdint.h>

#ifndef MPM_LANES
#define MPM_LANES 1
#endif

#define MPM_VECTORS 8 // that a law is given at most

#define MPM_KERNEL static inline __attribute__((always_inline))
#define MPM_UNLIKELY(condition) __builtin_expect(!!(condition), 0)
#define MPM_ALIGNED _Alignas(64) // of an array that mpm_load_aligned reads

// Has a cache line on its way, to be changed here: a common prefetch brings a copy, which to change
// takes another way to the core that has it.
MPM_KERNEL void mpm_prefetch_to_write(const void *line) {
#if defined __x86_64__
    __asm__ volatile("prefetchw %0" : : "m"(*(const char *)line)); // does nothing where unknown
#else
    __builtin_prefetch(line, 1);
#endif
}
// A moment's rest of a thread that looks at a word again and again.
MPM_KERNEL void mpm_pause(void) {
#if defined __x86_64__
    __builtin_ia32_pause();
#endif
}

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
MPM_KERNEL mpm_vec mpm_trunc(mpm_vec a) { // trunc would be a call without SSE 4.1
    return fabs(a) < 0x1p52 ? copysign((double)(int64_t)a, a) : a;
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
#define MPM_LESS(a, b) ((a) < (b) ? (a) : (b)) // fmin would be a call
#define MPM_MORE(a, b) ((a) > (b) ? (a) : (b))
MPM_KERNEL double mpm_hsum(mpm_vec a) {
    return MPM_FOLD(a, MPM_ADD);
}
MPM_KERNEL double mpm_hmin(mpm_vec a) {
    return MPM_FOLD(a, MPM_LESS);
}
MPM_KERNEL double mpm_hmax(mpm_vec a) {
    return MPM_FOLD(a, MPM_MORE);
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
// At most 1.04 ulp off (measured).
MPM_KERNEL mpm_vec mpm_exp(mpm_vec x) {
    const mpm_mask in_range = (x >= -708.0) & (x <= 709.0);
    const double round = 0x1.8p52; // added, leaves the nearest integer in the low bits
    const mpm_vec shifted = x * 1.4426950408889634 + round;
    const mpm_vec k = shifted - round;
    const mpm_vec r = (x - k * MPM_LN2_HIGH) - k * MPM_LN2_LOW;
    const mpm_vec r2 = r * r; // even and odd powers apart: half the latency
    mpm_vec even = 2.7625188948730094e-07 * r2 + 2.4801508679485814e-05;
    mpm_vec odd = 2.497820272246884e-08 * r2 + 2.755764144461859e-06;
    even = even * r2 + 0.0013888888926796587;
    odd = odd * r2 + 0.00019841269465584654;
    even = even * r2 + 0.041666666666603965;
    odd = odd * r2 + 0.008333333333500293;
    even = even * r2 + 0.5;
    odd = odd * r2 + 0.16666666666666433;
    const mpm_vec y = 1.0 + (r + r2 * (even + r * odd));
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

#if MPM_LANES > 1

// Four doubles, whatever MPM_LANES: a row of nodes.
typedef double mpm_four __attribute__((vector_size(32)));
MPM_KERNEL mpm_four mpm_load_four(const double *from) {
    return _mm256_load_pd(from);
}
MPM_KERNEL mpm_four mpm_positive_or_one(mpm_four a) {
    return _mm256_blendv_pd(_mm256_set1_pd(1), a,
                            _mm256_cmp_pd(a, _mm256_setzero_pd(), _CMP_GT_OQ));
}
MPM_KERNEL void mpm_store_four(double *to, mpm_four a) {
    _mm256_store_pd(to, a);
}
// Components of a node (server/mpm/grid.h) in 3D: bits of those that go with the weight, and of
// those that go with its gradient, the force.
MPM_KERNEL mpm_word mpm_sums(const int part) {
    const uint64_t all = UINT64_MAX;
#if MPM_LANES == 8
    (void)part;
    return (mpm_word){all, all, all, all, 0, 0, 0, all};
#else
    return part == 0 ? (mpm_word){all, all, all, all} : (mpm_word){0, 0, 0, all};
#endif
}
MPM_KERNEL mpm_word mpm_forces(const int part) {
    const uint64_t all = UINT64_MAX;
#if MPM_LANES == 8
    (void)part;
    return (mpm_word){0, 0, 0, 0, all, all, all, 0};
#else
    return part == 0 ? (mpm_word){0} : (mpm_word){all, all, all, 0};
#endif
}
// Eight lanes (4 lanes: the given half of them) of *one, but *other in lanes `first` and first + 1,
// which is 4 or 6.
MPM_KERNEL mpm_vec mpm_splat_two(const double *one, const double *other, const int first,
                                 const int part) {
#if MPM_LANES == 8
    (void)part;
    return _mm512_mask_broadcastsd_pd(_mm512_set1_pd(*one), (__mmask8)(3 << first),
                                      _mm_load_sd(other));
#else
    if (part == 0) {
        return _mm256_set1_pd(*one);
    }
    return first == 4 ? _mm256_blend_pd(_mm256_set1_pd(*one), _mm256_set1_pd(*other), 3)
                      : _mm256_blend_pd(_mm256_set1_pd(*one), _mm256_set1_pd(*other), 12);
#endif
}
// Lanes 6 and 7 of eight added to 4 and 5; what they then hold is not for use.
MPM_KERNEL mpm_vec mpm_join_pairs(mpm_vec a, const int part) {
#if MPM_LANES == 8
    (void)part;
    return _mm512_mask_add_pd(a, 0x30, a, _mm512_permutex_pd(a, 0x4e));
#else
    if (part == 0) {
        return a;
    }
    const __m128d sum = _mm_add_pd(_mm256_castpd256_pd128(a), _mm256_extractf128_pd(a, 1));
    return _mm256_insertf128_pd(_mm256_setzero_pd(), sum, 0);
#endif
}
// a where the bits of a lane are all set, 0 where none is.
MPM_KERNEL mpm_vec mpm_keep(mpm_vec a, mpm_word bits) {
    return (mpm_vec)((mpm_word)a & bits);
}
// The lower half of eight doubles where the upper half of a record is (8 lanes; the lower half is
// not for use); 4 lanes are that half themselves.
MPM_KERNEL mpm_vec mpm_load_upper(const double *from) {
#if MPM_LANES == 8
    const __m512d a = _mm512_load_pd(from);
    return _mm512_shuffle_f64x2(a, a, 0x44);
#else
    return _mm256_load_pd(from);
#endif
}
// All lanes from `lane` on, and *one in the lanes before, *other in these: a masked broadcast where
// there is one.
#if MPM_LANES == 8
typedef __mmask8 mpm_tail;
MPM_KERNEL mpm_tail mpm_tail_from(int lane) {
    return (mpm_tail)(0xffu << lane);
}
MPM_KERNEL mpm_vec mpm_splat_tail(const double *one, const double *other, mpm_tail tail) {
    return _mm512_mask_broadcastsd_pd(_mm512_set1_pd(*one), tail, _mm_load_sd(other));
}
#else
typedef mpm_mask mpm_tail;
MPM_KERNEL mpm_tail mpm_tail_from(int lane) {
    return (mpm_tail)mpm_lane_range(lane, 4);
}
MPM_KERNEL mpm_vec mpm_splat_tail(const double *one, const double *other, mpm_tail tail) {
    return mpm_select(tail, mpm_splat(*other), mpm_splat(*one));
}
#endif
// from[0], from[0], from[1], from[1], ...
MPM_KERNEL mpm_vec mpm_load_twice(const double *from) {
#if MPM_LANES == 8
    return _mm512_permutexvar_pd(_mm512_set_epi64(3, 3, 2, 2, 1, 1, 0, 0),
                                 _mm512_castpd256_pd512(_mm256_load_pd(from)));
#else
    return _mm256_permute4x64_pd(_mm256_castpd128_pd256(_mm_load_pd(from)), 0x50);
#endif
}
// *one in even lanes, *other in odd ones.
MPM_KERNEL mpm_vec mpm_splat_pair(const double *one, const double *other) {
#if MPM_LANES == 8
    return _mm512_mask_broadcastsd_pd(_mm512_set1_pd(*one), 0xaa, _mm_load_sd(other));
#else
    return _mm256_blend_pd(_mm256_set1_pd(*one), _mm256_set1_pd(*other), 10);
#endif
}
// to[0], to[1] += lanes 2 pair, 2 pair + 1.
MPM_KERNEL void mpm_add_pair(double *to, mpm_vec a, const int pair) {
#if MPM_LANES == 8
    const __m256d half = pair < 2 ? _mm512_castpd512_pd256(a) : _mm512_extractf64x4_pd(a, 1);
#else
    const __m256d half = a;
#endif
    const __m128d two = pair % 2 ? _mm256_extractf128_pd(half, 1) : _mm256_castpd256_pd128(half);
    _mm_store_pd(to, _mm_load_pd(to) + two);
}
// The lanes of b one place up, behind the last one of a.
MPM_KERNEL mpm_vec mpm_follow(mpm_vec a, mpm_vec b) {
#if MPM_LANES == 8
    return (mpm_vec)_mm512_alignr_epi64((__m512i)b, (__m512i)a, 7);
#else
    return _mm256_shuffle_pd(_mm256_permute2f128_pd(a, b, 0x21), b, 5);
#endif
}
// out[i] = from[which[i]] + plus[i], eight at a time, of eight to choose from.
MPM_KERNEL void mpm_pick_8(const uint32_t *from, const uint8_t *which, const uint8_t *plus,
                           uint32_t *out) {
    const __m256i index =
        _mm256_cvtepu8_epi32(_mm_loadl_epi64((const __m128i *)(const void *)which));
    const __m256i add = _mm256_cvtepu8_epi32(_mm_loadl_epi64((const __m128i *)(const void *)plus));
    const __m256i all = _mm256_loadu_si256((const __m256i *)(const void *)from);
    _mm256_storeu_si256((__m256i *)(void *)out,
                        _mm256_add_epi32(_mm256_permutevar8x32_epi32(all, index), add));
}
MPM_KERNEL void mpm_transpose_rows(__m256d a, __m256d b, __m256d c, __m256d d, double *out,
                                   const int stride) {
    const __m256d ab = _mm256_unpacklo_pd(a, b), cd = _mm256_unpacklo_pd(c, d);
    const __m256d AB = _mm256_unpackhi_pd(a, b), CD = _mm256_unpackhi_pd(c, d);
    _mm256_store_pd(out, _mm256_permute2f128_pd(ab, cd, 0x20));
    _mm256_store_pd(out + stride, _mm256_permute2f128_pd(AB, CD, 0x20));
    _mm256_store_pd(out + 2 * stride, _mm256_permute2f128_pd(ab, cd, 0x31));
    _mm256_store_pd(out + 3 * stride, _mm256_permute2f128_pd(AB, CD, 0x31));
}
// Four components (c and d may be NULL for 0) of four particles, to particle by particle: (4, 4).
MPM_KERNEL void mpm_transpose_4(const double *a, const double *b, const double *c, const double *d,
                                double *out) {
    const __m256d zero = _mm256_setzero_pd();
    mpm_transpose_rows(_mm256_load_pd(a), _mm256_load_pd(b), c ? _mm256_load_pd(c) : zero,
                       d ? _mm256_load_pd(d) : zero, out, 4);
}
// Eight components of MPM_LANES particles, to particle by particle: row i at out + i * stride.
#if MPM_LANES == 4
MPM_KERNEL void mpm_transpose(const mpm_vec *in, double *out, const int stride) {
    mpm_transpose_rows(in[0], in[1], in[2], in[3], out, stride);
    mpm_transpose_rows(in[4], in[5], in[6], in[7], out + 4, stride);
}
#else
MPM_KERNEL void mpm_transpose(const mpm_vec *in, double *out, const int stride) {
    __m512d pair[8], quad[8];
    for (int i = 0; i < 8; i += 2) { // pair[i]: particles 0 2 4 6 of components i, i + 1
        pair[i] = _mm512_unpacklo_pd(in[i], in[i + 1]);
        pair[i + 1] = _mm512_unpackhi_pd(in[i], in[i + 1]);
    }
    for (int i = 0; i < 2; i++) { // particles 2i', 2i' + 4 of components 0-3 and 4-7
        quad[i] = _mm512_shuffle_f64x2(pair[i], pair[i + 2], 0x88);
        quad[i + 2] = _mm512_shuffle_f64x2(pair[i], pair[i + 2], 0xdd);
        quad[i + 4] = _mm512_shuffle_f64x2(pair[i + 4], pair[i + 6], 0x88);
        quad[i + 6] = _mm512_shuffle_f64x2(pair[i + 4], pair[i + 6], 0xdd);
    }
    for (int i = 0; i < 2; i++) {
        _mm512_store_pd(out + i * stride, _mm512_shuffle_f64x2(quad[i], quad[i + 4], 0x88));
        _mm512_store_pd(out + (2 + i) * stride,
                        _mm512_shuffle_f64x2(quad[i + 2], quad[i + 6], 0x88));
        _mm512_store_pd(out + (4 + i) * stride, _mm512_shuffle_f64x2(quad[i], quad[i + 4], 0xdd));
        _mm512_store_pd(out + (6 + i) * stride,
                        _mm512_shuffle_f64x2(quad[i + 2], quad[i + 6], 0xdd));
    }
}
#endif

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
#if MPM_LANES == 1
MPM_KERNEL mpm_vec mpm_min(mpm_vec a, mpm_vec b) {
    return a < b ? a : b;
}
MPM_KERNEL mpm_vec mpm_max(mpm_vec a, mpm_vec b) {
    return a > b ? a : b;
}
#else
MPM_KERNEL mpm_vec mpm_min(mpm_vec a, mpm_vec b) {
    return MPM_SIMD(min_pd)(a, b);
}
MPM_KERNEL mpm_vec mpm_max(mpm_vec a, mpm_vec b) {
    return MPM_SIMD(max_pd)(a, b);
}
#endif
