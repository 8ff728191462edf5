/* @TITLE@
 *
 * Sampling time @SAMPLING_TIME@ s; inputs are held between samples.
@SIGNALS@
 */
#ifndef ASIA_MODEL_H
#define ASIA_MODEL_H

#ifdef ASIA_FLOAT
typedef float asia_real;
#else
typedef double asia_real;
#endif

#define ASIA_INPUTS @NU@
#define ASIA_OUTPUTS @NY@
#define ASIA_PAST_INPUTS @PAST_U@
#define ASIA_PAST_OUTPUTS @PAST_Y@
#define ASIA_SAMPLING_TIME @SAMPLING_TIME@

typedef struct {
    asia_real x[@STATES@];
} asia_state;

/* past_u[ASIA_PAST_INPUTS][ASIA_INPUTS] and past_y[ASIA_PAST_OUTPUTS][ASIA_OUTPUTS], the oldest
 * sample first; u: the input of the first sample to simulate. */
void asia_init(asia_state *x, const asia_real *past_u, const asia_real *past_y,
               const asia_real *u);
/* y of the sample that u belongs to. */
void asia_output(const asia_state *x, const asia_real *u, asia_real *y);
/* From this sample to the next. */
void asia_update(asia_state *x, const asia_real *u);
/* asia_output, then asia_update, in one computation. */
void asia_step(asia_state *x, const asia_real *u, asia_real *y);

#endif
