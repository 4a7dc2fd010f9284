/* Python's arithmetic in C. Whole numbers wrap around (-fwrapv); in a checked build that is a fault. */
#ifndef BG_PRELUDE
#define BG_PRELUDE
#include <math.h>
#include <stdbool.h>
#include <stdint.h>
#include <string.h>

#ifdef __GNUC__
#define BG_KERNEL static inline __attribute__((always_inline))
#define bg_prefetch(place) __builtin_prefetch(place, 1, 3)
#define bg_seldom(x) __builtin_expect(x, 0)
#else
#define BG_KERNEL static inline
#define bg_prefetch(place) ((void)0)
#define bg_seldom(x) (x)
#endif
#ifdef _WIN32
#define BG_EXPORT __declspec(dllexport)
#else
#define BG_EXPORT
#endif

#ifdef BG_CHECKED
/* A fault ends the call: its text goes back to Python. One home for all libraries of a process. */
#include <setjmp.h>
#include <stdio.h>
struct bg_home { jmp_buf place; char text[240]; };
__attribute__((weak)) _Thread_local struct bg_home bg_home;
static inline void bg_fault(const char *where, const char *what, int64_t a, int64_t b)
{
    snprintf(bg_home.text, sizeof bg_home.text, "%s: %s (%lld, %lld)", where, what, (long long)a, (long long)b);
    longjmp(bg_home.place, 1);
}
#define BG_CALLED(call) if (setjmp(bg_home.place)) return bg_home.text
#define BG_RETURNED 0
static inline int64_t bg_inside(int64_t k, int64_t n, const char *where)
{
    if (k < 0 || k >= n) bg_fault(where, "index outside an array of so many", k, n);
    return k;
}
static inline int64_t bg_index(int64_t k, int64_t n, const char *where) { return bg_inside(k < 0 ? k + n : k, n, where); }
static inline int64_t bg_fits(int64_t length, int64_t end, int64_t n, const char *where)
{
    if (length < 0 || end < length || end > n) bg_fault(where, "a part ends outside an array of so many", end, n);
    return length;
}
static inline void bg_same(int64_t m, int64_t n, const char *where)
{
    if (m != n) bg_fault(where, "arrays of different lengths", m, n);
}
#define BG_CHECK(name, text) \
    static inline int64_t bg_##name(int64_t a, int64_t b, const char *where) \
    { \
        int64_t c; \
        if (__builtin_##name##_overflow(a, b, &c)) bg_fault(where, "a whole number too large for 64 bits: " text, a, b); \
        return c; \
    }
#define __builtin_mult_overflow __builtin_mul_overflow
BG_CHECK(add, "+")
BG_CHECK(sub, "-")
BG_CHECK(mult, "*")
static inline void bg_divides(int64_t a, int64_t b, const char *where)
{
    if (!b) bg_fault(where, "division by 0", a, b);
}
#define BG_WHERE , const char *where
#else
#define BG_CALLED(call) (void)call
#define BG_RETURNED 0
#define BG_WHERE
#define bg_divides(a, b, where) ((void)0)
static inline int64_t bg_index(int64_t k, int64_t n) { return bg_seldom(k < 0) ? k + n : k; }
#endif

/* Division rounds down, as in Python; by 0 it gives 0. */
static inline int64_t bg_floor(int64_t a, int64_t b BG_WHERE)
{
    bg_divides(a, b, where);
    if (b == 0 || b == -1) return b ? -a : 0;
    int64_t q = a / b;
    return q - ((a % b != 0) && ((a < 0) != (b < 0)));
}
static inline int64_t bg_mod(int64_t a, int64_t b BG_WHERE)
{
    bg_divides(a, b, where);
    if (b == 0 || b == -1) return 0;
    int64_t r = a % b;
    return r && ((r < 0) != (b < 0)) ? r + b : r;
}
static inline double bg_mod_real(double a, double b)
{
    double r = fmod(a, b);
    if (r == 0) return copysign(0.0, b);
    return (b < 0) != (r < 0) ? r + b : r;
}
static inline double bg_floor_real(double a, double b) { return floor(a / b); }
static inline int64_t bg_power(int64_t a, int64_t b)
{
    int64_t r = 1;
    for (; b > 0; b--) r *= a;
    return r;
}
static inline int64_t bg_abs(int64_t a) { return a < 0 ? -a : a; }

/* The same on every machine, where C leaves numbers outside int64 open. */
static inline int64_t bg_whole(double x)
{
    return x >= -9223372036854775808.0 && x < 9223372036854775808.0 ? (int64_t)x : INT64_MIN;
}
static inline int64_t bg_floor_of(double x) { int64_t k = bg_whole(x); return k - (k > x); }
static inline int64_t bg_ceil_of(double x) { int64_t k = bg_whole(x); return k + (k < x); }

#define BG_LEAST(suffix, type) \
    static inline type bg_min_##suffix(type a, type b) { return b < a ? b : a; } \
    static inline type bg_max_##suffix(type a, type b) { return b > a ? b : a; }
BG_LEAST(i8, int64_t)
BG_LEAST(f8, double)
BG_LEAST(f4, float)

static inline int64_t bg_bits(float x) { int32_t i; memcpy(&i, &x, 4); return i; }
static inline float bg_of_bits(int64_t x) { int32_t i = (int32_t)x; float f; memcpy(&f, &i, 4); return f; }

/* An end of a slice, within 0..n; and how long a slice is. */
static inline int64_t bg_end(int64_t k, int64_t n)
{
    if (k < 0) k += n;
    return k < 0 ? 0 : k > n ? n : k;
}
static inline int64_t bg_span(int64_t first, int64_t end) { return end > first ? end - first : 0; }
#endif
