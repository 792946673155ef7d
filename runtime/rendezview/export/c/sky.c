/* Level and noise of the sky, and what exceeds it.
 *
 * The operations and their order are those of rendezview's own runtime, so that the outlines are
 * the same: keep them when the code is edited. */
#include <math.h>

#include "rendezview_frame.h"

#define MANY_WINDOWS 1000u /* along two borders: windows side by side are enough */

static uint32_t mean_of_window(const rdv_frame *frame, int32_t top, int32_t left)
{
    int32_t total = 4; /* rounds */
    int32_t x;
    int32_t y;

    for (y = top; y < (top + 3); y++)
    {
        for (x = left; x < (left + 3); x++)
        {
            total += rdv_grey_at(frame, x, y);
        }
    }
    return (uint32_t)total / 9u;
}

/* Grey level below which a share of the counts lies, within its bin by proportion. */
static rdv_f64 quantile(const uint32_t counts[256], uint32_t total, rdv_f64 share)
{
    const rdv_f64 wanted = share * (rdv_f64)total;
    uint32_t seen = 0u;
    uint32_t grey = 0u;

    while ((grey < 255u) && ((rdv_f64)(seen + counts[grey]) <= wanted))
    {
        seen += counts[grey];
        grey++;
    }
    return ((rdv_f64)grey - 0.5) + ((wanted - (rdv_f64)seen) / (rdv_f64)counts[grey]);
}

void rdv_look_at_sky(const rdv_frame *frame, rdv_f64 *level, rdv_f64 *noise)
{
    uint32_t counts[256];
    uint32_t total = 0u;
    const int32_t step = ((uint32_t)(frame->width + frame->height) > MANY_WINDOWS) ? 3 : 1;
    rdv_f64 below;
    int32_t k;

    for (k = 0; k < 256; k++)
    {
        counts[k] = 0u;
    }
    for (k = 0; k <= (frame->width - 3); k += step)
    {
        counts[mean_of_window(frame, 0, k)]++;
        counts[mean_of_window(frame, frame->height - 3, k)]++;
        total += 2u;
    }
    for (k = 0; k <= (frame->height - 3); k += step)
    {
        counts[mean_of_window(frame, k, 0)]++;
        counts[mean_of_window(frame, k, frame->width - 3)]++;
        total += 2u;
    }
    *level = quantile(counts, total, 0.5);
    /* 15.87 %: one sigma below the median of Gaussian noise */
    below = quantile(counts, total, 0.1587);
    *noise = *level - below;
    if (below <= 0.5)
    {
        /* a black sky, its noise cut off at 0: half a sigma above the median, at 69.15 % */
        const rdv_f64 above = 2.0 * (quantile(counts, total, 0.6915) - *level);

        *noise = (above > *noise) ? above : *noise;
    }
}

void rdv_mark_target(const rdv_frame *frame, rdv_f64 level)
{
    const int32_t limit = (int32_t)floor(level * 9.0);
    int32_t x;
    int32_t y;

    for (y = -1; y <= frame->height; y++)
    {
        const int32_t above = rdv_within(y - 1, 0, frame->height - 1);
        const int32_t here = rdv_within(y, 0, frame->height - 1);
        const int32_t below = rdv_within(y + 1, 0, frame->height - 1);
        int32_t before = rdv_grey_at(frame, 0, above) + rdv_grey_at(frame, 0, here) +
                         rdv_grey_at(frame, 0, below); /* the outermost pixels are repeated */
        int32_t middle = before;

        *rdv_mark_at(frame, -1, y) = RDV_MARK_SKY;
        *rdv_mark_at(frame, frame->width, y) = RDV_MARK_SKY;
        for (x = 0; x < frame->width; x++)
        {
            const int32_t next = rdv_within(x + 1, 0, frame->width - 1);
            const int32_t after = rdv_grey_at(frame, next, above) + rdv_grey_at(frame, next, here) +
                                  rdv_grey_at(frame, next, below);
            const int32_t total = before + middle + after;
            const uint8_t is_in = ((y >= 0) && (y < frame->height)) ? 1u : 0u;

            *rdv_mark_at(frame, x, y) =
                ((is_in == 1u) && (total > limit)) ? RDV_MARK_TARGET : RDV_MARK_SKY;
            before = middle;
            middle = after;
        }
    }
}
