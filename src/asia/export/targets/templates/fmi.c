/* FMI @VERSION@.0 co-simulation around model.c. */
#include "model.h"
#include <math.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#if defined _WIN32
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

#define PAST_U (ASIA_PAST_INPUTS * ASIA_INPUTS)
#define PAST_Y (ASIA_PAST_OUTPUTS * ASIA_OUTPUTS)
#define VALUES (ASIA_INPUTS + ASIA_OUTPUTS + PAST_U + PAST_Y)

enum { OK = 0, ERROR = 3 };

/* References count from 1: inputs, outputs, past inputs, past outputs. */
typedef struct {
    asia_state x;
    asia_real v[VALUES];
    double time;
    int started; /* 0: from the values; 1: at the first sample; 2: behind it */
} unit;

static void reset(unit *m)
{
    static const double start[VALUES] = {
        @STARTS@
    };
    int i;
    memset(m, 0, sizeof *m);
    for (i = 0; i < VALUES; ++i)
        m->v[i] = (asia_real)start[i];
}

static void start(unit *m)
{
    const asia_real *past = m->v + ASIA_INPUTS + ASIA_OUTPUTS;
    if (!m->started)
        asia_init(&m->x, past, past + PAST_U, m->v);
    m->started = m->started ? m->started : 1;
}

/* Outputs are those of the present sample, with the inputs that are set. */
static int get(unit *m, const uint32_t *refs, size_t n, double *values)
{
    size_t i;
    start(m);
    asia_output(&m->x, m->v, m->v + ASIA_INPUTS);
    for (i = 0; i < n; ++i) {
        if (refs[i] > VALUES)
            return ERROR;
        values[i] = refs[i] == 0 ? m->time : (double)m->v[refs[i] - 1];
    }
    return OK;
}

static int set(unit *m, const uint32_t *refs, size_t n, const double *values)
{
    size_t i;
    for (i = 0; i < n; ++i) {
        if (refs[i] == 0 || refs[i] > VALUES)
            return ERROR;
        m->v[refs[i] - 1] = (asia_real)values[i];
    }
    if (m->started == 1)
        m->started = 0;
    return OK;
}

static int advance(unit *m, double now, double step)
{
    if (!(fabs(step - ASIA_SAMPLING_TIME) <= 1e-6 * ASIA_SAMPLING_TIME))
        return ERROR;
    start(m);
    asia_update(&m->x, m->v);
    m->started = 2;
    m->time = now + step;
    return OK;
}

static unit *created(const char *token)
{
    unit *m = NULL;
    if (token == NULL || strcmp(token, "@TOKEN@") == 0)
        m = malloc(sizeof *m);
    if (m != NULL)
        reset(m);
    return m;
}
