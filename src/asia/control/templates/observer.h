/* @TITLE@
 *
 * Observer: estimates states and parameters sample by sample, and tests the model.
 * Sampling time @SAMPLING_TIME@ s; inputs are held between samples.
@SIGNALS@
 */
#ifndef ASIA_OBSERVER_H
#define ASIA_OBSERVER_H

#define ASIA_OBSERVER_INPUTS @NU@
#define ASIA_OBSERVER_OUTPUTS @NY@
#define ASIA_OBSERVER_PAST_INPUTS @PAST_U@
#define ASIA_OBSERVER_PAST_OUTPUTS @PAST_Y@
#define ASIA_OBSERVER_STATES @N@
#define ASIA_OBSERVER_PARAMETERS @P@

typedef struct {
    double z[ASIA_OBSERVER_STATES];
    double p[ASIA_OBSERVER_STATES * ASIA_OBSERVER_STATES];
    double statistic;
    long samples, zero, since;
} asia_observer;

typedef struct {
    double y_hat[ASIA_OBSERVER_OUTPUTS];                   /* expected before the measurement */
    double nis;                                            /* about as large as the outputs are many */
    double statistic;                                      /* alarm above @THRESHOLD@ */
    double parameters[ASIA_OBSERVER_PARAMETERS + 1];       /* @PARAMETERS@ */
    double deviations[ASIA_OBSERVER_PARAMETERS + 1];       /* their standard deviations */
    long since;                                            /* sample since which the model is not
                                                              valid any more; -1 while it is */
} asia_monitored;

/* past_u[PAST_INPUTS][INPUTS] and past_y[PAST_OUTPUTS][OUTPUTS], the oldest sample first; u: the
 * input of the first sample that is monitored. */
void asia_observer_init(asia_observer *o, const double *past_u, const double *past_y,
                        const double *u);
/* One sample; y is NAN where an output was not measured. */
void asia_observer_update(asia_observer *o, const double *u, const double *y,
                          asia_monitored *result);

#endif
