"""The C99 files around the generated statements."""

__all__ = ["GOLDEN", "HEADER", "SOURCE", "TEST"]

HEADER = """\
/* {about}: a frozen filter, written by difffilter {version}. Generated; do not edit.

{family}
   Belief: mean and deviations X, covariance P = X X^T. One step predicts over dt seconds and
   conditions on the channels that are present. Compiled in {default}; define {guard}_{other} for
   {other_word}. Not with -ffast-math: what is missing travels as NaN.

   cc -std=c99 -O2 -c {name}.c */
#ifndef {guard}_H
#define {guard}_H

{switch}{unusable}#ifdef {guard}_FLOAT
typedef float {name}_real;
#else
typedef double {name}_real;
#endif

#define {guard}_STATES {n}
{errors}#define {guard}_CHANNELS {m}

/* The frozen values. Others follow from them in {name}.c: to change one, export again. */
{constants}
{origin}
typedef struct {{
{fields}
}} {name}_belief;

{inputs}typedef struct {{
    {name}_real innovation[{m}];   /* nominal, 0 where missing */
    {name}_real standardised[{m}]; /* what the weight saw, in sigmas */
    {name}_real weight[{m}];       /* final, 0 where missing */
    {name}_real gate[{m}];         /* 1 passed, 0 failed */
}} {name}_result;

/* Start a belief; deviations is any factor X of the covariance, for example lower Cholesky. */
void {name}_start({name}_belief *belief, const {name}_real mean[{n}],
        {name}_real deviations[{p}][{p}]);

/* One step. present[i] is 0 where channel i is missing (z[i] is then not read); result may be
   NULL. Returns 0, 1 where the new belief is not finite, 2 where dt is not 0 or more; the belief
   and the result are then as they were. */
int {name}_step({name}_belief *belief, const {name}_real z[{m}],
        const unsigned char present[{m}], {name}_real dt{argument}, {name}_result *result);

#endif
"""

SOURCE = """\
/* Generated beside {name}.h; do not edit. C99 and libm alone. */
#include "{name}.h"

#include <float.h>
#include <math.h>
#include <stddef.h>
#include <string.h>

#ifdef __FAST_MATH__
#error "-ffast-math ignores NaN, which this needs"
#endif

#ifdef {guard}_FLOAT
#define REAL float
#define F(name) name##f
#define SMALLEST FLT_MIN
#define LARGEST FLT_MAX
#define EPSILON FLT_EPSILON
#define ROOT_SMALLEST 0x1p-63f
#define TINY(x) FLT_MIN
#else
#define REAL double
#define F(name) name
#define SMALLEST DBL_MIN
#define LARGEST DBL_MAX
#define EPSILON DBL_EPSILON
#define ROOT_SMALLEST 0x1p-511
#define TINY(x) x
#endif
#define ZERO ((REAL)0)
#define C_SQRT(x) F(sqrt)(x)
#define C_EXP(x) F(exp)(x)
#define C_LOG(x) F(log)(x)
#define C_LOG1P(x) F(log1p)(x)
#define C_TANH(x) F(tanh)(x)
#define C_SIN(x) F(sin)(x)
#define C_COS(x) F(cos)(x)
#define C_FLOOR(x) F(floor)(x)
#define C_ATAN2(y, x) F(atan2)(y, x)
#define C_EXPM1(x) F(expm1)(x)
#define C_TAN(x) F(tan)(x)
#define C_ASIN(x) F(asin)(x)
#define C_ACOS(x) F(acos)(x)
#define C_ATAN(x) F(atan)(x)
#define C_SINH(x) F(sinh)(x)
#define C_COSH(x) F(cosh)(x)
#define C_ASINH(x) F(asinh)(x)
#define C_ACOSH(x) F(acosh)(x)
#define C_ATANH(x) F(atanh)(x)
#define C_ERF(x) F(erf)(x)
#define C_ERFC(x) F(erfc)(x)
#define C_POW(y, x) F(pow)(y, x)
#define C_HYPOT(y, x) F(hypot)(y, x)
#define C_ABS(x) F(fabs)(x)

/* What follows from the frozen values. */
{derived}

void {name}_start({name}_belief *belief, const REAL mean[{n}], REAL deviations[{p}][{p}])
{{
    memcpy(belief->mean, mean, sizeof belief->mean);
    memcpy(belief->deviations, deviations, sizeof belief->deviations);
{start}}}

static int finite_numbers(const {name}_belief *belief)
{{
    for (int i = 0; i < {n}; i++)
        if (!isfinite(belief->mean[i]))
            return 0;
    for (int i = 0; i < {p}; i++)
        for (int j = 0; j < {p}; j++)
            if (!isfinite(belief->deviations[i][j]))
                return 0;
    return 1;
}}

int {name}_step({name}_belief *belief, const REAL z[{m}], const unsigned char present[{m}],
        REAL dt{argument}, {name}_result *result)
{{
    {name}_belief after;
    {name}_result made;
    if (!(dt >= ZERO && isfinite(dt)))
        return 2;
{step}
    if (!finite_numbers(&after))
        return 1;
    *belief = after;
    if (result != NULL)
        *result = made;
    return 0;
}}
"""

GOLDEN = """\
/* What the filter in Python makes of {rows} rows. Generated; do not edit. */
#define ROWS {rows}
#define N {n}
#define P {p}
#define M {m}
/* Of mean, covariance and innovations in their standard deviations, and of standardised
   innovations, weights and gates. In float: twenty times the deviation of the Python filter's own
   run in float. In double: 1e-12, or twenty times it in the roundings of double where the
   rows amplify it beyond. */
#define TOLERANCE_FLOAT {single}
#define TOLERANCE_DOUBLE {double}
{arrays}
"""

TEST = """\
/* Self-test of {name}.c: the largest deviation of mean, covariance and innovations from the
   golden ones, in the standard deviations of the row, and of standardised innovations, weights
   and gates. Returns 0 if it is within the tolerance.

   cc -std=c99 -O2 -Wall -Wextra -Werror -pedantic {name}.c {name}_test.c -lm && ./a.out
   The same with -D{guard}_{other} tests the version in {other_word}. */
#include <math.h>
#include <stdio.h>

#include "{name}.h"
#include "{name}_golden.h"

#ifdef {guard}_FLOAT
#define TOLERANCE TOLERANCE_FLOAT
#else
#define TOLERANCE TOLERANCE_DOUBLE
#endif

static double worst = 0.0;

/* A deviation; one that is no number stays the worst. */
static void apart(double found, double expected, double scale)
{{
    double d = fabs(found - expected) / scale;
    if (d > worst || d != d)
        worst = worst != worst ? worst : d;
}}

int main(void)
{{
    {name}_belief belief;
    {name}_result result;
{declare}    {name}_real mean[N], deviations[P][P];
    for (int i = 0; i < N; i++)
        mean[i] = ({name}_real){name}_golden_mean[i];
    for (int i = 0; i < P; i++)
        for (int j = 0; j < P; j++)
            deviations[i][j] = ({name}_real){name}_golden_deviations[i][j];
    {name}_start(&belief, mean, deviations);
    for (int k = 0; k < ROWS; k++) {{
        {name}_real z[M];
        unsigned char present[M];
        double covariance[P * P];
        for (int i = 0; i < M; i++) {{
            z[i] = ({name}_real){name}_golden_z[k][i];
            present[i] = {name}_golden_present[k][i] != 0.0;
        }}
{fill}        if ({name}_step(&belief, z, present, ({name}_real){name}_golden_dt[k]{pass},
                  &result)) {{
            printf("{name}: row %d: the belief is not finite\\n", k);
            return 1;
        }}
        for (int i = 0; i < P; i++) {{
            for (int j = 0; j < P; j++) {{
                double sum = 0.0;
                for (int l = 0; l < P; l++)
                    sum += (double)belief.deviations[i][l] * (double)belief.deviations[j][l];
                covariance[i * P + j] = sum;
            }}
        }}
        const double *sigma = {name}_golden_spread[k];
        for (int i = 0; i < N; i++)
            apart((double)belief.mean[i], {name}_golden_means[k][i], {name}_golden_size[k][i]);
        for (int i = 0; i < P; i++)
            for (int j = 0; j < P; j++)
                apart(covariance[i * P + j], {name}_golden_covariances[k][i][j],
                      sigma[i] * sigma[j]);
        for (int i = 0; i < M; i++) {{
            const double seen = {name}_golden_standardised[k][i];
            apart((double)result.innovation[i], {name}_golden_innovation[k][i],
                  {name}_golden_deviation[k][i]);
            apart((double)result.standardised[i], seen, fabs(seen) > 1.0 ? fabs(seen) : 1.0);
            apart((double)result.weight[i], {name}_golden_weight[k][i], 1.0);
            apart((double)result.gate[i], {name}_golden_gate[k][i], 1.0);
        }}
    }}
    printf("{name}: largest deviation %.3g, tolerance %.3g\\n", worst, TOLERANCE);
    return !(worst <= TOLERANCE);
}}
"""
