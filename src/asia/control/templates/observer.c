#define N ASIA_OBSERVER_STATES
#define NY ASIA_OBSERVER_OUTPUTS
#define NU ASIA_OBSERVER_INPUTS
#define FIRST (N - NY - ASIA_OBSERVER_PARAMETERS)

/* Variances of the first states, of what a sample adds, and of the noise. */
static const double start[N] = {@START@};
static const double drive[N] = {@DRIVE@};
static const double input_noise[NU] = {@INPUT_NOISE@};
static const double output_noise[NY] = {@OUTPUT_NOISE@};
/* Nominal value, standard deviation, least and greatest value, least deviation of a parameter. */
static const double parameters[ASIA_OBSERVER_PARAMETERS + 1][5] = {@VALUES@};

void asia_observer_init(asia_observer *o, const double *past_u, const double *past_y,
                        const double *u)
{
    int i;
    memset(o, 0, sizeof *o);
    o->since = -1;
    observer_initial(o->z, past_u, past_y, u);
    for (i = 0; i < N; ++i)
        o->p[i * N + i] = start[i];
}

static int all_finite(const double *values, int count)
{
    int i;
    for (i = 0; i < count; ++i)
        if (!isfinite(values[i]))
            return 0;
    return 1;
}

static void symmetric(double *p, const double *q)
{
    int i, j;
    for (i = 0; i < N; ++i)
        for (j = 0; j < N; ++j)
            p[i * N + j] = 0.5 * (q[i * N + j] + q[j * N + i]);
}

/* Replaces the rows of b (m, k) by the solution of a x = b; a (m, m) is overwritten. */
static void solve(double *a, double *b, int m, int k)
{
    int i, j, l, pivot;
    for (i = 0; i < m; ++i) {
        for (pivot = i, j = i + 1; j < m; ++j)
            if (fabs(a[j * m + i]) > fabs(a[pivot * m + i]))
                pivot = j;
        for (l = 0; l < m && pivot != i; ++l) {
            double t = a[i * m + l];
            a[i * m + l] = a[pivot * m + l];
            a[pivot * m + l] = t;
        }
        for (l = 0; l < k && pivot != i; ++l) {
            double t = b[i * k + l];
            b[i * k + l] = b[pivot * k + l];
            b[pivot * k + l] = t;
        }
        for (j = i + 1; j < m; ++j) {
            double factor = a[j * m + i] / a[i * m + i];
            for (l = i; l < m; ++l)
                a[j * m + l] -= factor * a[i * m + l];
            for (l = 0; l < k; ++l)
                b[j * k + l] -= factor * b[i * k + l];
        }
    }
    for (i = m - 1; i >= 0; --i)
        for (l = 0; l < k; ++l) {
            for (j = i + 1; j < m; ++j)
                b[i * k + l] -= a[i * m + j] * b[j * k + l];
            b[i * k + l] /= a[i * m + i];
        }
}

/* Corrects the states by the measured outputs and returns their number. */
static int corrected(asia_observer *o, const double *u, const double *y, asia_monitored *result)
{
    static const int columns = N + 1;
    double slope[NY * N], cross[N * NY] = {0}, spread[NY * NY] = {0};
    double solved[NY * (N + 1)] = {0}, error[NY] = {0}, z[N], p[N * N], q[N * N];
    int known[NY] = {0}, m = 0, i, j, k;
    observer_output(o->z, u, result->y_hat, slope);
    for (k = 0; k < NY; ++k)
        if (isfinite(y[k])) {
            known[m] = k;
            error[m++] = y[k] - result->y_hat[k];
        }
    for (i = 0; i < N; ++i)
        for (k = 0; k < m; ++k) {
            cross[i * m + k] = 0.0;
            for (j = 0; j < N; ++j)
                cross[i * m + k] += o->p[i * N + j] * slope[known[k] * N + j];
        }
    for (j = 0; j < m; ++j)
        for (k = 0; k < m; ++k) {
            spread[j * m + k] = j == k ? output_noise[known[j]] : 0.0;
            for (i = 0; i < N; ++i)
                spread[j * m + k] += slope[known[j] * N + i] * cross[i * m + k];
        }
    for (k = 0; k < m; ++k) {
        for (i = 0; i < N; ++i)
            solved[k * columns + i] = cross[i * m + k];
        solved[k * columns + N] = error[k];
    }
    solve(spread, solved, m, columns);
    result->nis = 0.0;
    for (k = 0; k < m; ++k)
        result->nis += error[k] * solved[k * columns + N];
    memcpy(z, o->z, sizeof z);
    memcpy(p, o->p, sizeof p);
    for (i = 0; i < N; ++i)
        for (k = 0; k < m; ++k) {
            z[i] += cross[i * m + k] * solved[k * columns + N];
            for (j = 0; j < N; ++j)
                p[i * N + j] -= cross[i * m + k] * solved[k * columns + j];
        }
    if (m && all_finite(z, N) && all_finite(p, N * N)) {
        memcpy(o->z, z, sizeof z);
        symmetric(q, p);
        memcpy(o->p, q, sizeof q);
    } else if (m) {
        result->nis = HUGE_VAL;
    }
    return m;
}

/* Multiplies the standard deviation of a parameter: by the forgetting, or to its first value. */
static void widened(asia_observer *o, int k, double limit)
{
    int place = FIRST + k, i;
    double room = parameters[k][1] / sqrt(fmax(o->p[place * N + place], 1e-300));
    double factor = fmin(limit, fmax(room, 1.0));
    for (i = 0; i < N; ++i)
        o->p[place * N + i] *= factor;
    for (i = 0; i < N; ++i)
        o->p[i * N + place] *= factor;
}

/* Keeps the parameters inside their ranges, and forgets. */
static void bounded(asia_observer *o)
{
    int k;
    for (k = 0; k < ASIA_OBSERVER_PARAMETERS; ++k) {
        o->z[FIRST + k] = fmin(fmax(o->z[FIRST + k], parameters[k][2]), parameters[k][3]);
        widened(o, k, 1.0 / sqrt(@FORGETTING@));
    }
}

/* Page's test, and parameters far from their nominal values. */
static void tested(asia_observer *o, int m, asia_monitored *result)
{
    const double threshold = @THRESHOLD@;
    double gained = 2.0 * threshold;
    int before = o->statistic > threshold, changed = 0, k;
    if (isfinite(result->nis))
        gained = @FACTOR@ * result->nis - @LOSS@ * m;
    o->statistic = fmin(fmax(o->statistic + gained, 0.0), 2.0 * threshold);
    if (o->statistic == 0.0)
        o->zero = o->samples + 1;
    for (k = 0; k < ASIA_OBSERVER_PARAMETERS; ++k) {
        int place = FIRST + k;
        result->parameters[k] = o->z[place];
        result->deviations[k] = sqrt(fmax(o->p[place * N + place], 0.0));
        changed |= fabs(o->z[place] - parameters[k][0])
                   > @DEVIATIONS@ * hypot(result->deviations[k], parameters[k][4]);
    }
    for (k = 0; k < ASIA_OBSERVER_PARAMETERS && o->statistic > threshold && !before; ++k)
        widened(o, k, HUGE_VAL);
    if (o->statistic > threshold) {
        if (o->since < 0 || o->zero < o->since)
            o->since = o->zero < o->samples ? o->zero : o->samples;
    } else if (changed) {
        if (o->since < 0)
            o->since = o->samples;
    } else if (o->statistic == 0.0) {
        o->since = -1;
    }
    result->statistic = o->statistic;
    result->since = o->since;
}

static void moved(asia_observer *o, const double *u)
{
    double z[N], slope[N * (N + NU)], fp[N * N], p[N * N];
    int i, j, k;
    observer_update(o->z, u, z, slope);
    for (i = 0; i < N; ++i)
        for (j = 0; j < N; ++j) {
            fp[i * N + j] = 0.0;
            for (k = 0; k < N; ++k)
                fp[i * N + j] += slope[i * (N + NU) + k] * o->p[k * N + j];
        }
    for (i = 0; i < N; ++i)
        for (j = 0; j < N; ++j) {
            double sum = i == j ? drive[i] : 0.0;
            for (k = 0; k < N; ++k)
                sum += fp[i * N + k] * slope[j * (N + NU) + k];
            for (k = 0; k < NU; ++k)
                sum += slope[i * (N + NU) + N + k] * input_noise[k] * slope[j * (N + NU) + N + k];
            p[i * N + j] = sum;
        }
    if (all_finite(z, N) && all_finite(p, N * N)) {
        memcpy(o->z, z, sizeof z);
        symmetric(o->p, p);
    }
}

void asia_observer_update(asia_observer *o, const double *u, const double *y,
                          asia_monitored *result)
{
    int m = corrected(o, u, y, result);
    bounded(o);
    tested(o, m, result);
    moved(o, u);
    o->samples += 1;
}
