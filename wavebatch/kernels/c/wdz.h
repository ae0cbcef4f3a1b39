/* Compressed packets of LAStools (.wdz, descriptor compression 1): docs/las-waveforms.md 1.3.

   A packet is its first sample as it is, and then the difference of each sample from the one before, by the range coder
   of LAZ: k, the number of its bits, with one adaptive model, and its place among the numbers of k bits with another
   one for each k; more than 8 bits as 8 coded ones and the rest plain. All models begin anew with every packet. Said
   (2004), Introduction to Arithmetic Coding, HP Labs HPL-2004-76, sections 3 and 4; the constants are those of LAZ. */

enum {
    SHIFT = 15,           /* bits of a distribution */
    BIT_SHIFT = 13,       /* the same of a single bit */
    HIGH_BITS = 8,        /* coded bits of a difference */
    LARGEST_BITS = 16,    /* of a sample */
    MOST_SYMBOLS = 256
};
static const uint32_t LEAST_LENGTH = 1u << 24;

typedef struct { /* frequencies of symbols, learned on the way */
    uint32_t symbols, total, cycle, left; /* left: symbols until distributions follow the counts again */
    uint32_t count[MOST_SYMBOLS], distribution[MOST_SYMBOLS + 1];
} Model;

typedef struct { /* of one packet */
    uint32_t value, length;
    const uint8_t *next, *end;
    int broken;
    uint32_t zeros, trials, chance, cycle, left; /* model of the single bit that tells 0 from 1 */
    Model bits;
    Model place[LARGEST_BITS + 1];
} Decoder;

static void follow_counts(Model *m)
{
    m->total += m->cycle;
    if (m->total > 1u << SHIFT) {
        m->total = 0;
        for (uint32_t i = 0; i < m->symbols; i++)
            m->total += m->count[i] = (m->count[i] + 1) >> 1;
    }
    uint32_t scale = 0x80000000u / m->total, sum = 0;
    for (uint32_t i = 0; i < m->symbols; i++) {
        m->distribution[i] = (scale * sum) >> (31 - SHIFT);
        sum += m->count[i];
    }
    uint32_t most = (m->symbols + 6) << 3;
    m->cycle = (5 * m->cycle) >> 2;
    m->left = m->cycle = m->cycle > most ? most : m->cycle;
}

static void begin_model(Model *m, uint32_t symbols)
{
    m->symbols = m->cycle = symbols;
    m->total = 0;
    for (uint32_t i = 0; i < symbols; i++)
        m->count[i] = 1;
    follow_counts(m);
    m->left = m->cycle = (symbols + 6) >> 1;
}

static inline void take_bytes(Decoder *d)
{
    d->broken |= d->value >= d->length || !d->length; /* no encoder leaves that */
    while (!d->broken && d->length < LEAST_LENGTH) {
        d->broken |= d->next == d->end;
        d->value = (d->value << 8) | (d->broken ? 0 : *d->next++);
        d->length <<= 8;
    }
}

static uint32_t take_symbol(Decoder *d, Model *m)
{
    uint32_t low = 0, high = m->symbols, from = 0, to = d->length;
    d->length >>= SHIFT;
    while (high - low > 1) {
        uint32_t middle = (low + high) >> 1, at = d->length * m->distribution[middle];
        if (at > d->value)
            high = middle, to = at;
        else
            low = middle, from = at;
    }
    d->value -= from;
    d->length = to - from;
    take_bytes(d);
    m->count[low]++;
    if (!--m->left)
        follow_counts(m);
    return low;
}

static uint32_t take_bit(Decoder *d)
{
    uint32_t at = d->chance * (d->length >> BIT_SHIFT), bit = d->value >= at;
    if (bit)
        d->value -= at, d->length -= at;
    else
        d->length = at, d->zeros++;
    take_bytes(d);
    if (--d->left)
        return bit;
    if ((d->trials += d->cycle) > 1u << BIT_SHIFT) {
        d->trials = (d->trials + 1) >> 1;
        d->zeros = (d->zeros + 1) >> 1;
        d->trials += d->zeros == d->trials;
    }
    d->chance = (d->zeros * (0x80000000u / d->trials)) >> (31 - BIT_SHIFT);
    d->cycle = (5 * d->cycle) >> 2;
    d->left = d->cycle = d->cycle > 64 ? 64 : d->cycle;
    return bit;
}

static int32_t take_difference(Decoder *d)
{
    uint32_t k = take_symbol(d, &d->bits);
    if (!k)
        return (int32_t)take_bit(d);
    if (!d->place[k].symbols) /* first used in this packet */
        begin_model(&d->place[k], 1u << (k > HIGH_BITS ? HIGH_BITS : k));
    int32_t c = (int32_t)take_symbol(d, &d->place[k]);
    if (k > HIGH_BITS && !d->broken) {
        uint32_t rest = k - HIGH_BITS, plain = d->value / (d->length >>= rest);
        d->value -= d->length * plain;
        d->broken |= plain >> rest;
        take_bytes(d);
        c = (c << rest) | (int32_t)(plain & ((1u << rest) - 1));
    }
    return c >= 1 << (k - 1) ? c + 1 : c - (1 << k) + 1;
}

static void begin_packet(Decoder *d, const uint8_t *from, const uint8_t *end, uint32_t bits)
{
    d->value = (uint32_t)from[0] << 24 | (uint32_t)from[1] << 16 | (uint32_t)from[2] << 8 | from[3];
    d->length = 0xFFFFFFFFu;
    d->next = from + 4, d->end = end, d->broken = 0;
    d->zeros = 1, d->trials = 2, d->chance = 1u << (BIT_SHIFT - 1), d->left = d->cycle = 4;
    begin_model(&d->bits, bits + 1);
    for (uint32_t k = 1; k <= bits; k++)
        d->place[k].symbols = 0;
}

/* Decodes n packets of `samples` samples of `bytes` (1 or 2) bytes into `out`; packet i lies in data[start[i]] to
   data[end[i] - 1]. good[i]: whether it is whole; a broken one has zeros from where it breaks. */
EXPORT int64_t decode_packets(const uint8_t *data, int64_t n, const int64_t *start, const int64_t *end,
                              int64_t samples, int64_t bytes, uint8_t *out, uint8_t *good)
{
    Decoder d;
    const int32_t range = 1 << (8 * bytes);
    for (int64_t i = 0; i < n; i++) {
        uint8_t *row = out + i * samples * bytes;
        const uint8_t *from = data + start[i];
        memset(row, 0, (size_t)(samples * bytes));
        good[i] = samples > 0 && end[i] - start[i] >= bytes + (samples > 1 ? 4 : 0);
        if (!good[i])
            continue;
        int32_t value = bytes == 1 ? from[0] : from[0] | from[1] << 8;
        if (samples > 1)
            begin_packet(&d, from + bytes, data + end[i], (uint32_t)(8 * bytes));
        for (int64_t j = 0; j < samples; j++) {
            if (j) {
                value += take_difference(&d);
                value += value < 0 ? range : value >= range ? -range : 0;
                if (d.broken)
                    break;
            }
            row[j * bytes] = (uint8_t)value;
            if (bytes == 2)
                row[j * 2 + 1] = (uint8_t)(value >> 8);
        }
        good[i] = samples < 2 || !d.broken;
    }
    return 0;
}
