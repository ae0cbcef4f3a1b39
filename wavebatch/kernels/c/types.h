/* What Python hands over, and what it gets back. wavebatch/kernels/library.py declares the same structures.

   All widths and times are in samples, all amplitudes in counts. */

enum { SUM_OF_GAUSSIANS, SKEWED, POWER, TABLE, LOG_NORMAL };

typedef struct { /* model of the system pulse, docs/algorithms.md 0 and R1 */
    int64_t kind;
    double skew;                               /* SKEWED */
    double power;                              /* POWER: exp(-|z|^power / 2) */
    int64_t n_components;                      /* SUM_OF_GAUSSIANS: further ones after the first */
    const double *components;                  /* weight, delay, additional variance of each */
    int64_t n_rows;                            /* TABLE */
    double first, step;
    const float *value, *slope;
    int64_t from_waveform;                     /* LOG_NORMAL: x = 1 is the first sample of the waveform, not the window */
} Pulse;

typedef struct {
    Pulse pulse;
    double width_ref, width_low, width_high;   /* of a new echo, and of any */
    double clip, floor;                        /* counts from which, and up to which, samples are cut off, or infinity */
    double noise_gain;                         /* noise variance per count of signal, H12 */
    double tolerance;                          /* a fit has converged when its next step promises less */
    double acceptance, misfit;                 /* fall of chi2 that one more echo needs, 2.3 and R3 */
    double prior_spread;                       /* of widths below width_ref; 0 for no prior, H1 */
    double gate_residual, gate_hermite;        /* of the residual test, 4.2 */
    double known;                              /* errors that an amplitude needs beside other echoes; 0: it is not asked */
    double skew_mean, skew_spread;             /* of free skews; spread 0: skews are not free */
    int64_t max_iterations, max_echoes, grow, thorough, free_levels, undamped, whitened;
    double whitening[3][3];                    /* row q: coefficients of a sample, and of those before it, after q others */
} Settings;

typedef struct { /* n waveforms of `length` samples */
    const void *samples;
    int64_t length;
    int64_t bytes;                             /* of a sample: 1, 2 or 4 of an unsigned count; 0 for float */
    const float *baseline;                     /* one per waveform, or one per sample */
    int64_t baseline_per_sample;
    const float *std;                          /* noise of each waveform */
    const uint8_t *missing;                    /* true where no sample was recorded; or NULL */
    const float *level_err;                    /* of the level of each waveform; or NULL */
} Block;

typedef struct { /* candidates that are fitted together, each cluster in its window low .. high - 1 of a waveform */
    int64_t n;
    const int64_t *waveform, *low, *high, *first, *number;
    const double *amplitude, *time, *width;    /* of the candidates */
} Clusters;

typedef struct { /* echoes of one cluster after the other; `room` of them fit */
    int64_t room;
    int64_t *number;                           /* per cluster */
    uint8_t *converged;
    double *cost;                              /* chi2 with prior */
    double *misfit;                            /* per echo: rms residual about it, in noise */
    double *parameters, *errors;               /* per echo: amplitude, time, width, skew */
    double *shared;                            /* per echo: covariance of width with amplitude, and with time */
    uint8_t *at_bound;
} Echoes;
