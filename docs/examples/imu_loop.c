/* Calibrated samples on a microcontroller: exports/<unit>/calibration.h in the loop of a sensor. C99, no allocation.
 *
 * Yours: read_sensor() and use(). Build with -DIMU_REAL=float where the floating-point unit is single precision, and put
 * calibration.h on the include path. */
#include <stdint.h>
#include "calibration.h"

/* Counts per unit of the range that the sensor is set to, from its data sheet (MPU6050: 2 g and 250 deg/s). */
#define COUNTS_PER_G 16384
#define COUNTS_PER_DPS 131

typedef struct {
    int16_t force[3], rate[3]; /* counts, in the axes of the calibration (see the header's remark on axes) */
    float temperature_degc; /* NAN where this sample has none */
    uint32_t time_us; /* of a free-running timer; it wraps after 71 minutes */
} raw_sample;

int read_sensor(raw_sample *sample); /* 1: a new sample, 0: no more */
void use(const imu_real f_g[3], const imu_real w_dps[3], double time_s);

void imu_loop(void)
{
    static imu_state state; /* all zeros: what one sample leaves to the next */
    raw_sample raw;
    uint32_t last_us = 0;
    double time_s = 0; /* since the first sample; double, as float resolves 4 ms after a day */
    int started = 0;
    while (read_sensor(&raw)) {
        imu_real read_f[3], read_w[3], f[3], w[3];
        int i;
        for (i = 0; i < 3; ++i) {
            read_f[i] = (imu_real)raw.force[i] / COUNTS_PER_G;
            read_w[i] = (imu_real)raw.rate[i] / COUNTS_PER_DPS;
        }
        if (started)
            time_s += 1e-6 * (double)(uint32_t)(raw.time_us - last_us); /* right across a wrap of the timer */
        last_us = raw.time_us;
        started = 1;
        imu_update(&state, read_f, read_w, (imu_real)raw.temperature_degc, time_s, f, w);
        use(f, w, time_s);
    }
}
