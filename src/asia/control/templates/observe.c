/* Monitors a CSV file: a row of names, then rows of inputs and outputs. */
#include "observer.h"
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define NU ASIA_OBSERVER_INPUTS
#define NY ASIA_OBSERVER_OUTPUTS
#define PAST_U ASIA_OBSERVER_PAST_INPUTS
#define PAST_Y ASIA_OBSERVER_PAST_OUTPUTS
#define PAST (PAST_U > PAST_Y ? PAST_U : PAST_Y)

int main(int argc, char **argv)
{
    static double past_u[PAST_U * NU + 1], past_y[PAST_Y * NY + 1], row[NU + NY];
    static char line[65536];
    asia_observer observer;
    asia_monitored result;
    long k, i;
    FILE *file = argc == 2 ? fopen(argv[1], "r") : NULL;
    if (file == NULL || fgets(line, sizeof line, file) == NULL) {
        fprintf(stderr, "usage: observe record.csv, with the columns @COLUMNS@\n");
        return 2;
    }
    printf("sample,@PRINTED@\n");
    for (k = 0; fgets(line, sizeof line, file) != NULL; ++k) {
        char *at = line, *end;
        for (i = 0; i < NU + NY; ++i, at = *end == ',' ? end + 1 : end) {
            row[i] = strtod(at, &end);
            if (end == at)
                row[i] = NAN;
        }
        if (k < PAST) {
            long from_u = k - (PAST - PAST_U), from_y = k - (PAST - PAST_Y);
            if (from_u >= 0)
                memcpy(past_u + from_u * NU, row, NU * sizeof *row);
            if (from_y >= 0)
                memcpy(past_y + from_y * NY, row + NU, NY * sizeof *row);
            continue;
        }
        if (k == PAST)
            asia_observer_init(&observer, past_u, past_y, row);
        asia_observer_update(&observer, row, row + NU, &result);
        printf("%ld", k);
        for (i = 0; i < NY; ++i)
            printf(",%.17g", result.y_hat[i]);
        printf(",%.17g,%.17g", result.nis, result.statistic);
        for (i = 0; i < ASIA_OBSERVER_PARAMETERS; ++i)
            printf(",%.17g,%.17g", result.parameters[i], result.deviations[i]);
        printf(",%ld\n", result.since < 0 ? -1 : result.since + PAST);
    }
    fclose(file);
    return 0;
}
