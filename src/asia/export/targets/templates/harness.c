#include "model.h"

void asia_run(const asia_real *past_u, const asia_real *past_y, const asia_real *u, asia_real *y,
              long samples);

void asia_run(const asia_real *past_u, const asia_real *past_y, const asia_real *u, asia_real *y,
              long samples)
{
    asia_state x;
    long k;
    asia_init(&x, past_u, past_y, u);
    for (k = 0; k < samples; ++k)
        asia_step(&x, u + k * ASIA_INPUTS, y + k * ASIA_OUTPUTS);
}
