/* From fits to echoes: height, datum and full width of the whole pulse in place of the parameters of its main component,
   with their errors; echoes that noise explains, or that lie outside of the waveform, are left out.

   stages/pulse_tables.py has the tables and their reasons. */

enum { AS_FITTED, STRETCHED, SUMMED };         /* how the pulse widens: parameters are those of the echo, or need tables */
static const double PROVEN_ALONE = 15;         /* fall of chi2 without an echo from which it is no error of the level: as for one more */
static const double LEAST_LEVEL = 5;           /* widths of an echo that show a level at least: its flanks still tell it from one */
enum { FLAG_NOT_CONVERGED = 1, FLAG_AT_BOUND = 2, FLAG_OVERLAPPED = 16 };

typedef struct { /* a pulse by its fitted width; a row has the peak, its slope by the width, sigma, and its slope */
    int64_t kind, n_near, n_wide;              /* rows of the table of usual widths, and of the one of wider pulses */
    const double *near_width, *near, *wide_width, *wide;
    double datum, ref, least;                  /* SUMMED: datum after the time; STRETCHED: the same over the width; least width, over ref */
} Whole;

typedef struct { /* what fits become echoes */
    const float *std;                          /* noise of each waveform */
    const float *level_err;                    /* of the level of each waveform, where fits left it free; or NULL */
    const double *factors;                     /* on the errors of amplitude, time, sigma and energy of each echo */
    double spacing, last, significance;        /* last sample of a waveform; least energy of an echo, in noise */
} Keeping;

typedef struct { /* core columns of a table of m echoes, and the row of each among the fitted ones */
    int64_t m;
    int32_t *waveform;
    double *time;
    float *amplitude, *sigma, *time_err, *amplitude_err, *sigma_err, *relative_energy_err, *residual;
    uint16_t *flags;
    int64_t *row;
} Table;

static double root_of(double variance) { return sqrt(variance < 0 ? 0 : variance); }

/* Covariances of the width with the amplitude and with the time are `shared`. */
static void describe_echo(const Whole *w, const double *fitted, const double *error, const double *shared, double *value, double *value_error) {
    memcpy(value, fitted, 3 * sizeof *value);
    memcpy(value_error, error, 3 * sizeof *value_error);
    if (w->kind == AS_FITTED) return;
    const double amplitude = fitted[0], width = fitted[2];
    double delay = w->datum, by_width = 0;
    if (w->kind == STRETCHED) {
        const double ratio = width / w->ref < w->least ? w->least : width / w->ref, square = ratio * ratio;
        delay = w->datum * w->ref * (ratio + 1 / square - 1);
        by_width = w->datum * (1 - 2 / (square * ratio));
    }
    value[1] += delay;
    value_error[1] = root_of(error[1] * error[1] + (by_width * error[2]) * (by_width * error[2]) + 2 * by_width * shared[1]);
    if (w->kind == STRETCHED) return;
    double row[4];
    if (width > w->near_width[w->n_near - 1]) interpolate_row(width, w->n_wide, 4, w->wide_width, w->wide, row);
    else interpolate_row(width, w->n_near, 4, w->near_width, w->near, row);
    const double peak = row[0], by_peak = amplitude * row[1], part = peak * error[0], other = by_peak * error[2];
    value[0] = amplitude * peak;
    value[2] = row[2];
    value_error[0] = root_of(part * part + other * other + 2 * peak * by_peak * shared[0]);
    value_error[2] = error[2] * fabs(row[3]);
}

/* n echoes of three parameters each, in place of them. */
EXPORT int64_t describe_echoes(int64_t n, const Whole *whole, double *values, double *errors, const double *shared) {
    for (int64_t i = 0; i < n; i++, values += 3, errors += 3, shared += 2) {
        const double fitted[3] = {values[0], values[1], values[2]}, error[3] = {errors[0], errors[1], errors[2]};
        describe_echo(whole, fitted, error, shared, values, errors);
    }
    return 0;
}

/* Returns the number of echoes that are kept. */
EXPORT int64_t keep_echoes(const Clusters *clusters, const Echoes *fits, const Whole *whole, const Keeping *keeping, const Table *out) {
    int64_t kept = 0, row = 0;
    for (int64_t c = 0; c < clusters->n; c++) {
        const int64_t waveform = clusters->waveform[c];
        const uint16_t common = (fits->converged[c] ? 0 : FLAG_NOT_CONVERGED) | (fits->number[c] > 1 ? FLAG_OVERLAPPED : 0);
        const float noise = (float)keeping->significance * keeping->std[waveform];
        const double std = keeping->std[waveform], level = keeping->level_err ? keeping->level_err[waveform] / std : 0;
        for (int64_t i = 0; i < fits->number[c]; i++, row++) {
            const double *fitted = fits->parameters + 4 * row, *error = fits->errors + 4 * row, *shared = fits->shared + 2 * row;
            const double *factor = keeping->factors + 4 * row, a = error[0] / fitted[0], w = error[2] / fitted[2];
            double value[3], errors[3];
            describe_echo(whole, fitted, error, shared, value, errors);
            for (int k = 0; k < 3; k++) errors[k] *= factor[k];
            const double square = value[0] * value[0] * value[2], energy = square * 1.7724538509055159; /* the root of pi */
            if (level > 0) { /* an error of the level explains its share of the squared sum of the samples */
                const double length = fmax(clusters->high[c] - clusters->low[c], LEAST_LEVEL * value[2]);
                const double share = level * level / (1 + level * level * length), sum = 6.283185307179586 * square * value[2]; /* 2 pi */
                if (energy - share * sum < PROVEN_ALONE * std * std) continue;
            }
            if (!(energy >= noise * noise && value[1] >= -0.5 * value[2] && value[1] <= keeping->last + 0.5 * value[2])) continue;
            if (!isfinite(errors[0]) || !isfinite(errors[1]) || !isfinite(errors[2])) continue;
            out->waveform[kept] = (int32_t)waveform;
            out->time[kept] = value[1] * keeping->spacing;
            out->amplitude[kept] = (float)value[0];
            out->sigma[kept] = (float)(value[2] * keeping->spacing);
            out->time_err[kept] = (float)(errors[1] * keeping->spacing);
            out->amplitude_err[kept] = (float)errors[0];
            out->sigma_err[kept] = (float)(errors[2] * keeping->spacing);
            out->relative_energy_err[kept] = (float)(root_of(a * a + w * w + 2 * shared[0] / (fitted[0] * fitted[2])) * factor[3]);
            out->residual[kept] = (float)fits->misfit[row];
            out->flags[kept] = common | (fits->at_bound[row] ? FLAG_AT_BOUND : 0);
            out->row[kept++] = row;
        }
    }
    return kept;
}
