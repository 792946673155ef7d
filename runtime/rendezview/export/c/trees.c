/* Signature to active nodes: the trees, each at its own roll, and their common direction. */
#include <math.h>
#include <stddef.h>

#include "rendezview_flight.h"

#define PI 3.14159265358979323846
#define MOST_ROLL_RAD 3.2
#define ROLL_STEP_RAD (PI / 90.0)
#define MEAN_SHIFT_STEPS 5u
/* 1.5 * 2^23: a float to which this is added is rounded to a whole number, as rintf does. */
#define TO_WHOLE 12582912.0f

typedef struct
{
    rdv_f32 part;    /* of the way from one bin to the next */
    uint16_t start;  /* bin of the view that is bin 0 of the tree */
    rdv_index entry; /* branch or, at the end, sum of steps */
    uint16_t end;    /* reference to the leaf */
} rdv_walk;

static rdv_walk begin(uint32_t tree, rdv_f64 roll_rad)
{
    const rdv_f64 shift = (-roll_rad * (rdv_f64)RDV_BINS) / (2.0 * PI);
    int32_t whole = (int32_t)shift;
    rdv_walk walk;

    if ((rdv_f64)whole > shift)
    {
        whole -= 1; /* floor */
    }
    walk.part = (rdv_f32)(shift - (rdv_f64)whole);
    if (whole < 0)
    {
        whole += (int32_t)RDV_BINS;
    }
    walk.start = (uint16_t)whole;
    walk.entry = rdv_roots[tree];
    walk.end = 0u;
    return walk;
}

/* Trust of each of `count` trees (0: off). All trees descend one level at a time and stop at
 * their leaves: no branch depends on the data, so the time does not either but for the depth. */
static void ask(const rdv_f32 readings[RDV_BINS], const uint16_t *trees, const rdv_f64 *rolls_rad,
                uint32_t count, rdv_f64 *trust)
{
    rdv_f32 twice[(2u * RDV_BINS) + 1u]; /* so no index wraps */
    rdv_walk walks[RDV_NODES];
    uint16_t waiting[RDV_NODES];
    uint32_t left = count;
    uint32_t i;

    for (i = 0u; i < RDV_BINS; i++)
    {
        twice[i] = readings[i];
        twice[RDV_BINS + i] = readings[i];
    }
    twice[2u * RDV_BINS] = readings[0];
    for (i = 0u; i < count; i++)
    {
        walks[i] = begin(trees[i], rolls_rad[i]);
        waiting[i] = (uint16_t)i;
    }
    while (left > 0u)
    {
        uint32_t still = 0u;

        for (i = 0u; i < left; i++)
        {
            const uint16_t place = waiting[i];
            rdv_walk *const walk = &walks[place];
            const rdv_branch *const branch = &rdv_branches[walk->entry];
            const uint32_t bin = (uint32_t)walk->start + ((uint32_t)branch->bin * RDV_BIN_STEP);
            const rdv_f32 *const at = &twice[bin];
            const rdv_f32 rest = 1.0f - walk->part;
            const rdv_f32 reading = ((rest * at[0]) + (walk->part * at[1])) + TO_WHOLE;
            const rdv_f32 threshold = (rdv_f32)rdv_thresholds[walk->entry] + TO_WHOLE;
            const uint16_t child = branch->child[(reading <= threshold) ? 0u : 1u];

            walk->entry = (rdv_index)(walk->entry + child);
            walk->end = child;
            waiting[still] = place;
            /* 0 is a leaf for off; values above the longest step are leaves for on */
            still += (((uint32_t)child - 1u) < RDV_LONGEST_STEP) ? 1u : 0u;
        }
        left = still;
    }
    for (i = 0u; i < count; i++)
    {
        const uint32_t end = walks[i].end;

        trust[i] = 0.0;
        if (end > RDV_LONGEST_STEP)
        {
            const uint32_t leaf = (uint32_t)rdv_first_on[trees[i]] + (end - RDV_LONGEST_STEP - 1u);

            trust[i] = rdv_trusts[rdv_on_leaves[leaf]];
        }
    }
}

static rdv_f64 dot(const rdv_f64 a[3], const rdv_f64 b[3])
{
    return ((a[0] * b[0]) + (a[1] * b[1])) + (a[2] * b[2]);
}

static rdv_f64 kernel(rdv_f64 cosine)
{
    return exp((cosine - 1.0) / RDV_KERNEL_WIDTH);
}

/* From the best supported of the directions, a few steps of a mean shift. */
void rdv_agree(rdv_on_nodes *found)
{
    uint32_t start = 0u;
    rdv_f64 most = -1.0;
    uint32_t i;
    uint32_t j;

    for (i = 0u; i < found->count; i++)
    {
        rdv_f64 support = 0.0;

        for (j = 0u; j < found->count; j++)
        {
            support += found->trust[j] * kernel(dot(rdv_directions[found->nodes[i]],
                                                    rdv_directions[found->nodes[j]]));
        }
        if (support > most)
        {
            start = i;
            most = support;
        }
    }
    for (i = 0u; i < 3u; i++)
    {
        found->direction[i] = rdv_directions[found->nodes[start]][i];
    }
    for (i = 0u; i < MEAN_SHIFT_STEPS; i++)
    {
        rdv_f64 total[3] = {0.0, 0.0, 0.0};
        rdv_f64 length;

        found->support = 0.0;
        for (j = 0u; j < found->count; j++)
        {
            const rdv_f64 *const b = rdv_directions[found->nodes[j]];
            const rdv_f64 weight = found->trust[j] * kernel(dot(found->direction, b));

            found->weights[j] = weight;
            found->support += weight;
            total[0] += weight * b[0];
            total[1] += weight * b[1];
            total[2] += weight * b[2];
        }
        length = sqrt(dot(total, total));
        found->direction[0] = total[0] / length;
        found->direction[1] = total[1] / length;
        found->direction[2] = total[2] / length;
    }
}

/* Roll of the view against a node: the twist of view * node^T about the line of sight. */
static rdv_f64 twist(const rdv_f64 view[9], const rdv_f64 node[6])
{
    return atan2(dot(&view[3], &node[0]) - dot(&view[0], &node[3]),
                 dot(&view[0], &node[0]) + dot(&view[3], &node[3]));
}

rdv_status rdv_all_trees(const rdv_f32 readings[RDV_BINS], const rdv_f64 rolls_rad[RDV_NODES],
                         rdv_f64 trust[RDV_NODES])
{
    rdv_status status = RDV_OK;

    if ((readings == NULL) || (rolls_rad == NULL) || (trust == NULL))
    {
        status = RDV_BAD_INPUT;
    }
    else
    {
        uint16_t trees[RDV_NODES];
        uint32_t k;

        for (k = 0u; k < RDV_NODES; k++)
        {
            trees[k] = (uint16_t)k;
            if (!(fabs(rolls_rad[k]) <= MOST_ROLL_RAD)) /* NaN too */
            {
                status = RDV_BAD_INPUT;
            }
        }
        if (status == RDV_OK)
        {
            ask(readings, trees, rolls_rad, RDV_NODES, trust);
        }
    }
    return status;
}

void rdv_centred(const rdv_signature *signature, const rdv_f64 camera_from_target[9],
                 rdv_f64 centred_from_target[9])
{
    uint32_t row;
    uint32_t column;

    for (row = 0u; row < 3u; row++)
    {
        for (column = 0u; column < 3u; column++)
        {
            const rdv_f64 *const a = &signature->centred_from_camera[3u * row];
            const rdv_f64 *const b = &camera_from_target[column];

            centred_from_target[(3u * row) + column] =
                ((a[0] * b[0]) + (a[1] * b[3])) + (a[2] * b[6]);
        }
    }
}

rdv_status rdv_nodes_near(const rdv_f64 centred_from_target[9], rdv_f64 cosine,
                          uint16_t near[RDV_NODES], uint32_t *count)
{
    rdv_status status = RDV_OK;
    uint32_t k;

    for (k = 0u; k < 9u; k++)
    {
        if (!(fabs(centred_from_target[k]) <= 1.001)) /* no element of a rotation; NaN too */
        {
            status = RDV_BAD_INPUT;
        }
    }
    *count = 0u;
    for (k = 0u; (k < RDV_NODES) && (status == RDV_OK); k++)
    {
        if (-dot(rdv_directions[k], &centred_from_target[6]) >= cosine)
        {
            near[*count] = (uint16_t)k;
            *count += 1u;
        }
    }
    return status;
}

rdv_status rdv_search(const rdv_signature *signature, const rdv_f64 centred_from_target[9],
                      rdv_f64 reach_rad, rdv_on_nodes *found)
{
    rdv_status status = RDV_BAD_INPUT;
    uint16_t near[RDV_NODES];
    uint32_t count = 0u;

    if ((signature != NULL) && (centred_from_target != NULL) && (found != NULL) &&
        (reach_rad >= 0.0))
    {
        status = rdv_nodes_near(centred_from_target, cos(fmin(reach_rad, PI)) - 1e-12, near,
                                &count);
    }
    if (status == RDV_OK)
    {
        rdv_f64 rolls_rad[RDV_NODES] = {0.0};
        rdv_f64 trust[RDV_NODES];
        uint32_t k;

        rolls_rad[0] = 0.0; /* no node may be near */
        for (k = 0u; k < count; k++)
        {
            rolls_rad[k] = twist(centred_from_target, rdv_attitudes[near[k]]);
        }
        ask(signature->readings, near, rolls_rad, count, trust);
        found->count = 0u;
        found->support = 0.0;
        for (k = 0u; k < count; k++)
        {
            if (trust[k] > 0.0)
            {
                found->nodes[found->count] = near[k];
                found->trust[found->count] = trust[k];
                found->count++;
            }
        }
        if (found->count > 0u)
        {
            rdv_agree(found);
        }
        else
        {
            status = RDV_UNRECOGNIZED;
        }
    }
    return status;
}

/* The attitude of a camera that is rolled by an angle about its boresight. */
static void roll_by(rdv_f64 roll_rad, const rdv_f64 attitude[9], rdv_f64 rolled[9])
{
    const rdv_f64 c = cos(roll_rad);
    const rdv_f64 s = sin(roll_rad);
    uint32_t k;

    for (k = 0u; k < 3u; k++)
    {
        rolled[k] = (c * attitude[k]) - (s * attitude[3u + k]);
        rolled[3u + k] = (s * attitude[k]) + (c * attitude[3u + k]);
        rolled[6u + k] = attitude[6u + k];
    }
}

rdv_status rdv_search_around(const rdv_signature *signature, const rdv_f64 centred_from_target[9],
                             rdv_f64 error_rad, rdv_on_nodes *found)
{
    rdv_status status = RDV_BAD_INPUT;

    if ((centred_from_target != NULL) && (found != NULL) && (error_rad >= 0.0) &&
        (error_rad <= PI))
    {
        const rdv_f64 reach_rad = error_rad + RDV_MARGIN_RAD;
        const int32_t most = (int32_t)ceil(error_rad / ROLL_STEP_RAD);
        rdv_f64 rolled[9];
        rdv_f64 best_rad = 0.0;
        rdv_f64 best = 0.0;
        int32_t k;

        for (k = -most; k <= most; k++)
        {
            const rdv_f64 roll_rad = (rdv_f64)k * ROLL_STEP_RAD;

            roll_by(roll_rad, centred_from_target, rolled);
            status = rdv_search(signature, rolled, reach_rad, found);
            if ((status == RDV_OK) && (found->support > best))
            {
                best = found->support;
                best_rad = roll_rad;
            }
        }
        roll_by(best_rad, centred_from_target, rolled);
        status = rdv_search(signature, rolled, reach_rad, found);
    }
    return status;
}
