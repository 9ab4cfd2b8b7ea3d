"""Elementary functions in C that a compiler turns into vector code, accurate to an ulp or two.

Calls into libm would stop it. Rational approximations: S. L. Moshier, Cephes.
"""

__all__ = ["CALLS", "FUNCTIONS", "INLINE", "power", "whole"]

#: Operation -> name of the C function.
INLINE = {
    "exp": "x_exp", "log": "x_log", "log1p": "x_log1p", "tanh": "x_tanh", "hypot": "x_hypot",
    "pow": "x_pow",
}  # fmt: skip
#: Operations that call libm, by the same name: no compiler turns them into vector code.
CALLS = (
    "sin", "cos", "tan", "asin", "acos", "atan", "atan2", "sinh", "cosh", "asinh", "acosh",
    "atanh", "erf", "erfc", "expm1",
)  # fmt: skip
#: Whole exponents up to which a power is a product.
MOST = 16


def whole(text: str) -> int | None:
    """The small whole exponent that a text is, or None."""
    try:
        value = float(text.strip("()"))
    except ValueError:
        return None
    return int(value) if value == int(value) and abs(value) <= MOST else None


def power(base: str, exponent: int) -> str:
    """A whole power as C."""
    if exponent < 0:
        return f"1.0 / {power(base, -exponent)}"
    if exponent <= 1:
        return base if exponent else "1.0"
    return f"x_pow{exponent}({base})"


def _products() -> str:
    """Functions x_pow2, x_pow3, ...: squares and one product."""
    lines = []
    for n in range(2, MOST + 2):
        half = "x" if n // 2 == 1 else f"x_pow{n // 2}(x)"
        tail = " * x" if n % 2 else ""
        lines.append(
            f"static inline double x_pow{n}(double x) {{ double h = {half}; return h * h{tail}; }}"
        )
    return "\n".join(lines) + "\n"


FUNCTIONS = r"""
static inline uint64_t to_bits(double x) { uint64_t b; memcpy(&b, &x, 8); return b; }
static inline double from_bits(uint64_t b) { double x; memcpy(&x, &b, 8); return x; }

/* 2^n of a whole n in [-1022, 1023] */
static inline double power2(double n)
{
    return from_bits((to_bits(n + 6755399441055744.0) + 1023) << 52);
}

static inline double x_exp(double x)
{
    double y = x > 710.0 ? 710.0 : x;
    y = y < -746.0 ? -746.0 : y;
    double n = floor(1.4426950408889634 * y + 0.5);
    double r = (y - n * 6.93145751953125E-1) - n * 1.42860682030941723212E-6;
    double z = r * r;
    double p = r * ((1.26177193074810590878E-4 * z + 3.02994407707441961300E-2) * z
                    + 9.99999999999999999910E-1);
    double q = ((3.00198505138664455042E-6 * z + 2.52448340349684104192E-3) * z
                + 2.27265548208155028766E-1) * z + 2.0;
    double e = 1.0 + 2.0 * p / (q - p);
    double half = floor(0.5 * n);
    e = e * power2(half) * power2(n - half);
    return x != x ? x : e;
}

static inline double x_log(double x)
{
    double tiny = x < 2.2250738585072014E-308 ? 1.0 : 0.0;
    double y = tiny != 0.0 ? x * 18014398509481984.0 : x;
    uint64_t b = to_bits(y);
    /* the exponent as a double, by way of the mantissa of 2^52 */
    double e = from_bits((b >> 52) | 0x4330000000000000ULL) - 4503599627370496.0 - 1022.0;
    double m = from_bits((b & 0x000FFFFFFFFFFFFFULL) | 0x3FE0000000000000ULL);
    double low = m < 0.70710678118654752440 ? 1.0 : 0.0;
    e = e - low - (tiny != 0.0 ? 54.0 : 0.0);
    double f = (low != 0.0 ? m + m : m) - 1.0;
    double z = f * f;
    double p = ((((1.01875663804580931796E-4 * f + 4.97494994976747001425E-1) * f
                  + 4.70579119878881725854E0) * f + 1.44989225341610930846E1) * f
                + 1.79368678507819816313E1) * f + 7.70838733755885391666E0;
    double q = ((((f + 1.12873587189167450590E1) * f + 4.52279145837532221105E1) * f
                 + 8.29875266912776603211E1) * f + 7.11544750618563894466E1) * f
               + 2.31251620126765340583E1;
    double v = f * (z * p / q) - e * 2.121944400546905827679E-4 - 0.5 * z;
    v = f + v + e * 0.693359375;
    v = x < INFINITY ? v : x;            /* infinity and NaN */
    v = x == 0.0 ? -INFINITY : v;
    return x < 0.0 ? NAN : v;
}

static inline double x_log1p(double x)
{
    double u = 1.0 + x, d = u - 1.0;
    double v = x_log(u) * (x / (d == 0.0 ? 1.0 : d));
    v = u < INFINITY ? v : u;
    return d == 0.0 ? x : v;
}

static inline double x_tanh(double x)
{
    double a = fabs(x), z = x * x;
    double small = x + x * z * ((-9.64399179425052238628E-1 * z - 9.92877231001918586564E1) * z
                                - 1.61468768441708447952E3)
                   / (((z + 1.12811678491632931402E2) * z + 2.23548839060100448583E3) * z
                      + 4.84406305325125486048E3);
    double large = 1.0 - 2.0 / (x_exp(a + a) + 1.0);
    large = x < 0.0 ? -large : large;
    return a < 0.625 ? small : large;
}

static inline double x_hypot(double x, double y)
{
    double a = fabs(x), b = fabs(y);
    double most = a < b ? b : a, least = a < b ? a : b;
    double q = least / (most == 0.0 ? 1.0 : most);
    double v = most * sqrt(1.0 + q * q);
    v = x != x || y != y ? NAN : v;
    return a == INFINITY || b == INFINITY ? INFINITY : v;
}

static inline double x_pow(double a, double b)
{
    double size = x_exp(b * x_log(fabs(a)));
    double half = 0.5 * b;
    double is_whole = floor(b) == b ? 1.0 : 0.0, even = floor(half) == half ? 1.0 : 0.0;
    double v = copysign(1.0, a) < 0.0 && is_whole != 0.0 && even == 0.0 ? -size : size;
    v = a < 0.0 && a > -INFINITY && is_whole == 0.0 ? NAN : v;
    v = a == -1.0 && fabs(b) == INFINITY ? 1.0 : v;
    return b == 0.0 || a == 1.0 ? 1.0 : v;
}
""" + _products()
