#include "observer.h"
#include <string.h>

void asia_observe(const double *past_u, const double *past_y, const double *u, const double *y,
                  double *found, long samples);

/* found: expected outputs, NIS, statistic, parameters, deviations and `since` of each sample. */
void asia_observe(const double *past_u, const double *past_y, const double *u, const double *y,
                  double *found, long samples)
{
    asia_observer observer;
    asia_monitored result;
    long k;
    const size_t ny = ASIA_OBSERVER_OUTPUTS, p = ASIA_OBSERVER_PARAMETERS;
    asia_observer_init(&observer, past_u, past_y, u);
    for (k = 0; k < samples; ++k) {
        asia_observer_update(&observer, u + k * ASIA_OBSERVER_INPUTS, y + k * (long)ny, &result);
        memcpy(found, result.y_hat, ny * sizeof *found);
        found[ny] = result.nis;
        found[ny + 1] = result.statistic;
        memcpy(found + ny + 2, result.parameters, p * sizeof *found);
        memcpy(found + ny + 2 + p, result.deviations, p * sizeof *found);
        found[ny + 2 + 2 * p] = (double)result.since;
        found += ny + 3 + 2 * p;
    }
}
