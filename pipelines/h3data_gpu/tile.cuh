// A tile of the rasteriser: what boxes it may see, and its depth so far.

#ifndef HOLES
#define HOLES 1  // 0: no texture of these scenes cuts anything out, and the code for it is left away
#endif
#ifndef TILE
#define TILE 64
#define WARPS 8
#define BLOCKS 4
#endif
#define THREADS (WARPS * 32)
#define COARSE (TILE / 8)
#define COARSE_WORDS ((COARSE * COARSE + 3) / 4 * 4)
#define BUCKETS 128
#define BUCKETS_PER_M 8.f
#define NEAR_M 0.02f             // nearer vertices are left to the double path
#define SMALLEST_M 1e-4f         // as on the CPU: a plane through the eye itself is not seen
#define LARGE_PX 1024            // so are triangles whose box in the tile has so many pixels,
#define SLENDER_M 150.f          // and those whose squared length times their depth exceeds this times their doubled area
#define EXACT_TEST_PX 96         // rectangles up to so many pixels are tested pixel by pixel
#define BEHIND -2.f              // in place of 1/z: at or behind the eye's plane
#define TOO_NEAR -1.f
#define GENEROUS_PX 1e-4         // the double path's triangles are larger by this, against cracks


struct Tile {
    float cx, cy;                // principal point, from the tile's corner [px]; so are all pixels below
    int width, height;
};

struct Rect {
    float near, x0, y0, x1, y1;  // nearest z [m]; pixels
};

struct Buffers {
    u64* pixels;                 // depth bits << 32 | word
    float* coarse;               // an upper bound of z in every 8x8 block
    float near;                  // what is nearer is cut away [m]
};

struct Scratch {                 // of a warp
    float4 corners[CLUSTER_VERTICES];    // x, y [px] from the first pixel's centre, 1/z
    uint2 triangles[CLUSTER_TRIANGLES];  // three vertices; box: x, y, width, height
};

__device__ __forceinline__ float fast_inverse(float x) { return __fdividef(1.f, x); }

__device__ __forceinline__ void load_placement(const float* from, float* m) {
    const float4* rows = (const float4*)from;
    for (int r = 0; r < 3; r++) {
        float4 row = rows[r];
        m[4 * r] = row.x, m[4 * r + 1] = row.y, m[4 * r + 2] = row.z, m[4 * r + 3] = row.w;
    }
}

// Whether a box may be seen in the tile, and where. Whatever is NaN is not.
__device__ __forceinline__ bool visible(const float* m, float4 c, float4 h, const Tile& t, Rect& out) {
    float x = m[0] * c.x + m[1] * c.y + m[2] * c.z + m[3];
    float y = m[4] * c.x + m[5] * c.y + m[6] * c.z + m[7];
    float z = m[8] * c.x + m[9] * c.y + m[10] * c.z + m[11];
    float extent_z = fabsf(m[8]) * h.x + fabsf(m[9]) * h.y + fabsf(m[10]) * h.z;
    if (!(z + extent_z > 0.f)) return false;
    // the tile's four side planes
    const float slack = 1e-3f;
#define BEYOND(row, bound, value, sign)                                                                               \
    {                                                                                                                 \
        float b = bound;                                                                                              \
        float reach = fabsf(m[row] - b * m[8]) * h.x + fabsf(m[row + 1] - b * m[9]) * h.y                             \
            + fabsf(m[row + 2] - b * m[10]) * h.z;                                                                    \
        if (!(sign (value - b * z) + reach >= -slack)) return false;                                                  \
    }
    BEYOND(0, -t.cx, x, +)
    BEYOND(0, t.width - t.cx, x, -)
    BEYOND(4, -t.cy, y, +)
    BEYOND(4, t.height - t.cy, y, -)
#undef BEYOND
    out.near = (z - extent_z) * 0.99999f;
    if (out.near < NEAR_M) {     // at the eye: it may cover anything
        out = {0.f, 0.f, 0.f, (float)t.width, (float)t.height};
        return true;
    }
    float extent_x = fabsf(m[0]) * h.x + fabsf(m[1]) * h.y + fabsf(m[2]) * h.z;
    float extent_y = fabsf(m[4]) * h.x + fabsf(m[5]) * h.y + fabsf(m[6]) * h.z;
    float per_near = fast_inverse(out.near), per_far = fast_inverse(z + extent_z);
    float left = x - extent_x, right = x + extent_x, top = y - extent_y, bottom = y + extent_y;
    const float margin = 0.05f;
    out.x0 = fmaxf(t.cx + left * (left > 0 ? per_far : per_near) - margin, 0.f);
    out.x1 = fminf(t.cx + right * (right > 0 ? per_near : per_far) + margin, (float)t.width);
    out.y0 = fmaxf(t.cy + top * (top > 0 ? per_far : per_near) - margin, 0.f);
    out.y1 = fminf(t.cy + bottom * (bottom > 0 ? per_near : per_far) + margin, (float)t.height);
    return out.x0 <= out.x1 && out.y0 <= out.y1;
}

__device__ __forceinline__ int row_of(int k, float per_width) { return (int)(((float)k + 0.5f) * per_width); }


// Whether no pixel centre of the rectangle is further than its nearest z. All lanes give the same arguments.
__device__ __forceinline__ bool hidden(const Buffers& b, const Tile& t, const Rect& r, int lane) {
    int x0 = max(0, (int)ceilf(r.x0 - 0.5f)), x1 = min(t.width - 1, (int)floorf(r.x1 - 0.5f));
    int y0 = max(0, (int)ceilf(r.y0 - 0.5f)), y1 = min(t.height - 1, (int)floorf(r.y1 - 0.5f));
    int w = x1 - x0 + 1, h = y1 - y0 + 1;
    if (w <= 0 || h <= 0) return true;
    bool seen = false;
    if (w * h <= EXACT_TEST_PX) {
        const volatile u32* halves = (const volatile u32*)b.pixels;
        u32 near = __float_as_uint(r.near);
        float per_width = fast_inverse((float)w);
        for (int k = lane; k < w * h; k += 32) {
            int y = row_of(k, per_width), x = k - y * w;
            seen |= halves[2 * ((y0 + y) * TILE + x0 + x) + 1] >= near;
        }
    } else {
        const volatile float* coarse = b.coarse;
        x0 >>= 3, y0 >>= 3;
        w = (x1 >> 3) - x0 + 1, h = (y1 >> 3) - y0 + 1;
        float per_width = fast_inverse((float)w);
        for (int k = lane; k < w * h; k += 32) {
            int y = row_of(k, per_width), x = k - y * w;
            seen |= coarse[(y0 + y) * COARSE + x0 + x] >= r.near;
        }
    }
    return !__any_sync(FULL, seen);
}

// The same for a lane's own rectangle, if it is small: only the coarse blocks, and false if in doubt.
__device__ __forceinline__ bool hidden_coarsely(const Buffers& b, const Tile& t, const Rect& r) {
    int x0 = (int)(r.x0 * 0.125f), x1 = min((t.width - 1) >> 3, (int)(r.x1 * 0.125f));
    int y0 = (int)(r.y0 * 0.125f), y1 = min((t.height - 1) >> 3, (int)(r.y1 * 0.125f));
    if (x1 - x0 > 2 || y1 - y0 > 2) return false;
    const volatile float* coarse = b.coarse;
    for (int y = y0; y <= y1; y++)
        for (int x = x0; x <= x1; x++)
            if (coarse[y * COARSE + x] >= r.near) return false;
    return true;
}

__device__ __forceinline__ void blend(const Buffers& b, int x, int y, float z, u32 word) {
    u64* pixel = b.pixels + y * TILE + x;
    u32 depth = __float_as_uint(z);
    if (depth <= ((volatile u32*)pixel)[1] && z >= b.near) atomicMin(pixel, (u64)depth << 32 | word);
}

// Take the bound of the coarse blocks under a rectangle anew.
__device__ __forceinline__ void refresh(const Buffers& b, const Tile& t, const Rect& r, int lane) {
    __syncwarp();
    int x0 = (int)(r.x0 * 0.125f), x1 = min((t.width - 1) >> 3, (int)(r.x1 * 0.125f));
    int y0 = (int)(r.y0 * 0.125f), y1 = min((t.height - 1) >> 3, (int)(r.y1 * 0.125f));
    const volatile u32* halves = (const volatile u32*)b.pixels;
    for (int j = y0; j <= y1; j++)
        for (int i = x0; i <= x1; i++) {
            int x = i * 8 + (lane & 7), y = j * 8 + (lane >> 3);
            u32 z = 0;
            if (x < t.width && y < t.height) z = halves[2 * (y * TILE + x) + 1];
            if (x < t.width && y + 4 < t.height) {
                u32 below = halves[2 * ((y + 4) * TILE + x) + 1];
                z = max(z, below);
            }
            z = __reduce_max_sync(FULL, z);
            if (lane == 0) b.coarse[j * COARSE + i] = __uint_as_float(z);
        }
}

