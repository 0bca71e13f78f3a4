"""The text of ``calibration.h`` around a unit's numbers: plain C99, no allocation, no dependency but ``math.h``."""

HEAD = """\
/*{remarks}
 */
#ifndef IMU_CALIBRATION_H
#define IMU_CALIBRATION_H

#include <math.h>

#ifndef IMU_REAL
#define IMU_REAL double
#endif
typedef IMU_REAL imu_real;

#define IMU_ROUNDS {rounds} /* of the fixed point; 1 where none is needed */
#define IMU_TURN_ACCELEROMETER {turn_accelerometer} /* whether its effects look at what they change */
#define IMU_TURN_GYROSCOPE {turn_gyroscope}
#define IMU_ENDS {ends} /* what is kept of the sample before, for each round */
#ifndef IMU_TEMPERATURE_MEMORY
#define IMU_TEMPERATURE_MEMORY {memory} /* s; 0 takes the temperature as it is */
#endif

{tables}
/* What the body does at a sample. */
typedef struct {{
    imu_real f[3], w[3]; /* specific force, g; angular rate, deg/s */
    imu_real alpha[3]; /* angular acceleration, deg/s^2 */
    imu_real direction[3]; /* unit vector of the turn that goes on, or of the last one */
    imu_real temperature, time; /* degC; s since power-on */
    int alone; /* whether time and the samples before are not known */
}} imu_motion;

/* What a sample leaves to the next. */
typedef struct {{
    int known; /* whether there was one */
    double time;
    imu_real w[3], direction[3];
}} imu_end;

/* Of one sensor; start it with all zeros: imu_state state = {{0}}; */
typedef struct {{
    imu_end ends[IMU_ENDS];
    double stretch, sums[5]; /* the fading line of the temperature */
}} imu_state;

static inline imu_real imu_length(const imu_real v[3])
{{
    return (imu_real)sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]);
}}

"""

FUNCTIONS = {
    "imu_sign": """\
static inline double imu_sign(double x)
{
    return (x > 0) - (x < 0);
}
""",
    "imu_minimum": """\
static inline double imu_minimum(double a, double b)
{
    return a < b ? a : b;
}
""",
    "imu_maximum": """\
static inline double imu_maximum(double a, double b)
{
    return a > b ? a : b;
}
""",
    "imu_step": """\
static inline double imu_step(double x)
{
    return x >= 0 ? 1 : 0;
}
""",
    "imu_band": """\
static inline double imu_band(double x, double low, double high)
{
    return x >= low && x <= high ? 1 : 0;
}
""",
    "imu_square": """\
static inline imu_real imu_square(imu_real x)
{
    return x * x;
}
""",
    "imu_cube": """\
static inline imu_real imu_cube(imu_real x)
{
    return x * x * x;
}
""",
}

EFFECTS = """\
/* Take off a reading of the {sensor} what {which} add. */
static inline void imu_{sensor}_{kind}(const imu_motion *m, imu_real r[3])
{{
    const imu_real *f = m->f, *w = m->w, *u = m->{own};
    const imu_real dt = m->temperature - {reference};
    (void)f; (void)w; (void)u; (void)dt; (void)r;
{lines}
}}

"""

LINEAR = """\
static inline void imu_linear(const imu_real matrix[3][3], const imu_real bias[3], const imu_real r[3], imu_real out[3])
{
    const imu_real x = r[0] - bias[0], y = r[1] - bias[1], z = r[2] - bias[2];
    int i;
    for (i = 0; i < 3; ++i)
        out[i] = matrix[i][0] * x + matrix[i][1] * y + matrix[i][2] * z;
}

static inline int imu_near(const imu_real a[3], const imu_real b[3])
{
    int i;
    for (i = 0; i < 3; ++i) {
        const imu_real size = a[i] < 0 ? -a[i] : a[i], change = a[i] < b[i] ? b[i] - a[i] : a[i] - b[i];
        if (change > (imu_real)1e-13 * (size > 1 ? size : 1))
            return 0;
    }
    return 1;
}

"""

FOLLOW = """\
/* Fill in what follows from the truths and from the sample before. */
static inline void imu_follow(imu_motion *m, const imu_end *end, double time)
{
    const imu_real speed = imu_length(m->w);
    const double step = end->known ? time - end->time : 0;
    int i;
    for (i = 0; i < 3; ++i) {
        m->alpha[i] = step > 0 ? (imu_real)((m->w[i] - end->w[i]) / step) : 0;
        m->direction[i] = speed > (imu_real)0.25 ? m->w[i] / speed : end->direction[i];
    }
}

static inline void imu_keep(imu_end *end, const imu_motion *m, double time)
{
    int i;
    for (i = 0; i < 3; ++i)
        end->direction[i] = m->direction[i];
    if (m->w[0] - m->w[0] == 0 && m->w[1] - m->w[1] == 0 && m->w[2] - m->w[2] == 0) {
        end->known = 1;
        end->time = time;
        for (i = 0; i < 3; ++i)
            end->w[i] = m->w[i];
    }
}

"""

LINE = """\
/* The line through the past of the temperature, with exponentially fading weights. */
static inline double imu_smooth(imu_state *s, double temperature, double time)
{
    const double memory = IMU_TEMPERATURE_MEMORY, stretch = floor(time / (4 * memory));
    const double step = (stretch - s->stretch) * (4 * memory), at = time - stretch * (4 * memory);
    double *S = s->sums, first, second, determinant;
    int i;
    if (step != 0 && S[0] > 0) { /* carry the sums over to another stretch */
        const double fade = exp(-step / memory);
        S[2] = S[2] - 2 * step * S[1] + step * step * S[0];
        S[1] -= step * S[0];
        S[4] -= step * S[3];
        for (i = 0; i < 5; ++i)
            S[i] *= fade;
    }
    s->stretch = stretch;
    if (temperature == temperature) {
        const double weight = exp(at / memory), above = temperature - 25, leaned = weight * at;
        S[0] += weight;
        S[1] += leaned;
        S[2] += leaned * at;
        S[3] += weight * above;
        S[4] += leaned * above;
    }
    first = S[1] - at * S[0];
    second = S[2] - 2 * at * S[1] + at * at * S[0];
    determinant = S[0] * second - first * first;
    if (determinant > 1e-15 * S[0] * S[0] * memory * memory)
        return (second * S[3] - first * (S[4] - at * S[3])) / determinant + 25;
    return S[3] / S[0] + 25;
}

"""

MAIN = """\
/* Take off the effects of the motion: of the sensors that take turns, or of the others. */
static inline void imu_pass(const imu_motion *m, const imu_real rf[3], const imu_real rw[3], int turn,
                            imu_real f[3], imu_real w[3])
{{
    imu_real af[3], aw[3];
    int i;
    for (i = 0; i < 3; ++i) {{
        af[i] = rf[i];
        aw[i] = rw[i];
        f[i] = m->f[i];
        w[i] = m->w[i];
    }}
    if (IMU_TURN_ACCELEROMETER == turn) {{
        imu_accelerometer_moving(m, af);
        imu_linear(imu_accelerometer_matrix, imu_accelerometer_bias, af, f);
    }}
    if (IMU_TURN_GYROSCOPE == turn) {{
        imu_gyroscope_moving(m, aw);
        imu_linear(imu_gyroscope_matrix, imu_gyroscope_bias, aw, w);
    }}
}}

static inline void imu_solve(imu_state *state, const imu_real raw_f[3], const imu_real raw_w[3], imu_motion m,
                             double time, imu_real f[3], imu_real w[3])
{{
    imu_real rf[3], rw[3];
    int round, i, settled = !(IMU_TURN_ACCELEROMETER || IMU_TURN_GYROSCOPE);
    for (i = 0; i < 3; ++i) {{
        rf[i] = raw_f[i];
        rw[i] = raw_w[i];
    }}
    imu_accelerometer_steady(&m, rf);
    imu_gyroscope_steady(&m, rw);
    imu_linear(imu_accelerometer_matrix, imu_accelerometer_bias, rf, m.f);
    imu_linear(imu_gyroscope_matrix, imu_gyroscope_bias, rw, m.w);
    for (round = 0; round < IMU_ROUNDS; ++round) {{
        imu_real nf[3], nw[3];
{past}        if (settled)
            continue; /* what is kept for later rounds is that of the solution */
        imu_pass(&m, rf, rw, 1, nf, nw);
        settled = imu_near(nf, m.f) && imu_near(nw, m.w);
        for (i = 0; i < 3; ++i) {{
            m.f[i] = nf[i];
            m.w[i] = nw[i];
        }}
    }}
    imu_pass(&m, rf, rw, 0, f, w);
    (void)state; (void)time;
}}

/* Compensate the next sample of a sensor. raw_f, f: specific force, g; raw_w, w: angular rate, deg/s; temperature in
 * degC (NAN: none with this sample); time in s since power-on, increasing.
 * It gives what python -m pipeline apply does. */
static inline void imu_update(imu_state *state, const imu_real raw_f[3], const imu_real raw_w[3],
                              imu_real temperature_degc, double time_s, imu_real f[3], imu_real w[3])
{{
    imu_motion m = {{{{0, 0, 0}}, {{0, 0, 0}}, {{0, 0, 0}}, {{0, 0, 0}}, 0, 0, 0}};
    m.temperature = {temperature};
    m.time = (imu_real)time_s;
    imu_solve(state, raw_f, raw_w, m, time_s, f, w);
}}

/* Compensate one sample by itself: the temperature is taken as it is{alone}. */
static inline void imu_compensate(const imu_real raw_f[3], const imu_real raw_w[3], imu_real temperature_degc,
                                  imu_real f[3], imu_real w[3])
{{
    imu_motion m = {{{{0, 0, 0}}, {{0, 0, 0}}, {{0, 0, 0}}, {{0, 0, 0}}, 0, 0, 1}};
    imu_state state = {{0}};
    m.temperature = temperature_degc;
    imu_solve(&state, raw_f, raw_w, m, 0, f, w);
}}

#endif
"""

PAST = """\
        imu_end *end = &state->ends[round < IMU_ENDS ? round : IMU_ENDS - 1];
        imu_follow(&m, end, time);
        imu_keep(end, &m, time);
"""
