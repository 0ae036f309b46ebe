// Clusters drawn into a tile: small triangles pair by pair, the others exactly.

struct Cutouts {
    const float2* uv;            // per pool vertex
    const int* triangle_textures;
    const int3* maps;            // per texture: where its opacity begins, width, height
    const unsigned char* opacity;
};

struct NoHoles {
    __device__ __forceinline__ bool solid(u32, int, float, float) const { return true; }
};

// Holes of a cluster: `h3data/render/cutouts.py` on the GPU.
struct CutOut {
    const Cutouts* tables;       // null: it is not cut out
    int first_triangle, first_vertex;

    __device__ __forceinline__ static int texel_before(float coordinate, int size, float& way) {
        float place = (coordinate - floorf(coordinate)) * size - 0.5f;
        if (place < 0.f) place += size;
        float before = fminf(fmaxf(floorf(place), 0.f), size - 1.f);
        way = place - before;
        return (int)before;
    }

    // Whether there is something of a triangle of the cluster, given its corners and the weights of the second and third.
    __device__ __forceinline__ bool solid(u32 triangle, int number, float b1, float b2) const {
        const float2* corners = tables->uv + first_vertex;
        float2 a = corners[triangle & 255], b = corners[(triangle >> 8) & 255], c = corners[(triangle >> 16) & 255];
        int3 map = tables->maps[tables->triangle_textures[first_triangle + number]];
        float right, lower;
        int column = texel_before(a.x - floorf(a.x) + b1 * (b.x - a.x) + b2 * (c.x - a.x), map.y, right);
        int row = texel_before(a.y - floorf(a.y) + b1 * (b.y - a.y) + b2 * (c.y - a.y), map.z, lower);
        const unsigned char* at = tables->opacity + map.x + (size_t)row * (map.y + 1) + column;
        float above = at[0] + ((float)at[1] - at[0]) * right;
        at += map.y + 1;
        return above + (at[0] + ((float)at[1] - at[0]) * right - above) * lower >= 127.5f;
    }
};

// Triangles by homogeneous edge functions (Olano & Greer 1997): every lane sets up its own, if `exact`, in double; then the
// whole warp draws one after another. Not inlined, and given the matrix where it lies in memory: so it costs the caller no
// registers.
template <class Holes>
__device__ __noinline__ void draw_exactly(
    Buffers b, float center_x, float center_y, const float* m, const float* vertices, const uint2* triangles, bool exact,
    int number, u32 first_word, int lane, Holes holes
) {
    float edge[3], edge_x[3], edge_y[3];
    double w = 0., w_x = 0., w_y = 0.;
    if (exact) {
        u32 triangle = triangles[number].x, place = triangles[number].y;
        double p[3][3], e[3][3], s[3], u[3];
        for (int j = 0; j < 3; j++) {
            const float* v = vertices + 3 * ((triangle >> (8 * j)) & 255);
            for (int r = 0; r < 3; r++)
                p[j][r] = (double)m[4 * r] * v[0] + (double)m[4 * r + 1] * v[1] + (double)m[4 * r + 2] * v[2] + m[4 * r + 3];
        }
        // the rows of the inverse of [p0 p1 p2] give each barycentric over z as a linear function of the ray
        for (int j = 0; j < 3; j++) {
            const double *q = p[(j + 1) % 3], *r = p[(j + 2) % 3];
            e[j][0] = q[1] * r[2] - q[2] * r[1];
            e[j][1] = q[2] * r[0] - q[0] * r[2];
            e[j][2] = q[0] * r[1] - q[1] * r[0];
            s[j] = p[1][j] - p[0][j];
            u[j] = p[2][j] - p[0][j];
        }
        double determinant = p[0][0] * e[0][0] + p[0][1] * e[0][1] + p[0][2] * e[0][2];
        exact = determinant != 0.;
        double k = 1. / determinant;
        double ray_x = (place & 255) + 0.5 - center_x, ray_y = ((place >> 8) & 255) + 0.5 - center_y;
        w_x = (s[1] * u[2] - s[2] * u[1]) * k;
        w_y = (s[2] * u[0] - s[0] * u[2]) * k;
        w = w_x * ray_x + w_y * ray_y + (s[0] * u[1] - s[1] * u[0]) * k;
        float far_x = (float)((place >> 16) & 255) - 1.f, far_y = (float)(place >> 24) - 1.f;
        for (int j = 0; j < 3; j++) {
            double dx = e[j][0] * k, dy = e[j][1] * k;
            edge_x[j] = (float)dx;
            edge_y[j] = (float)dy;
            edge[j] = (float)(dx * ray_x + dy * ray_y + e[j][2] * k + GENEROUS_PX * (fabs(dx) + fabs(dy)));
            if (edge[j] + fmaxf(edge_x[j], 0.f) * far_x + fmaxf(edge_y[j], 0.f) * far_y < 0.f) exact = false;
        }
    }
    for (u32 waiting = __ballot_sync(FULL, exact); waiting; waiting &= waiting - 1) {
        int owner = __ffs(waiting) - 1, one = __shfl_sync(FULL, number, owner);
        u32 place = triangles[one].y;
        float e[3], e_x[3], e_y[3];
        for (int j = 0; j < 3; j++) {
            e[j] = __shfl_sync(FULL, edge[j], owner);
            e_x[j] = __shfl_sync(FULL, edge_x[j], owner);
            e_y[j] = __shfl_sync(FULL, edge_y[j], owner);
        }
        double z = __shfl_sync(FULL, w, owner), z_x = __shfl_sync(FULL, w_x, owner), z_y = __shfl_sync(FULL, w_y, owner);
        int x0 = place & 255, y0 = (place >> 8) & 255, width = (place >> 16) & 255, height = place >> 24;
        float per_width = fast_inverse((float)width);
        for (int i = lane; i < width * height; i += 32) {
            int y = row_of(i, per_width), x = i - y * width;
            float fx = (float)x, fy = (float)y;
            float e0 = fmaf(e_x[0], fx, fmaf(e_y[0], fy, e[0]));
            float e1 = fmaf(e_x[1], fx, fmaf(e_y[1], fy, e[1]));
            float e2 = fmaf(e_x[2], fx, fmaf(e_y[2], fy, e[2]));
            if (!(fminf(fminf(e0, e1), e2) >= 0.f)) continue;
            float inverse = (float)(z + z_x * fx + z_y * fy);
            if (!(inverse > 0.f)) continue;
            float depth = __frcp_rn(inverse);
            if (holes.solid(triangles[one].x, one, e1 * depth, e2 * depth)) blend(b, x0 + x, y0 + y, depth, first_word + one);
        }
    }
}

// Setting up a triangle: its pixel box (x, y, width, height; tile-relative; no area = nothing to draw) and its path.
__device__ __forceinline__ int4 set_up(const float4* corners, u32 triangle, const Tile& t, bool& exactly) {
    float4 a = corners[triangle & 255], b = corners[(triangle >> 8) & 255], c = corners[(triangle >> 16) & 255];
    float smallest = fminf(fminf(a.z, b.z), c.z), largest = fmaxf(fmaxf(a.z, b.z), c.z);
    exactly = false;
    if (smallest <= 0.f) {
        exactly = largest > BEHIND;  // something of it is in front of the eye
        return exactly ? make_int4(0, 0, t.width, t.height) : make_int4(0, 0, 0, 0);
    }
    float left = fminf(fminf(a.x, b.x), c.x), right = fmaxf(fmaxf(a.x, b.x), c.x);
    float top = fminf(fminf(a.y, b.y), c.y), bottom = fmaxf(fmaxf(a.y, b.y), c.y);
    const float margin = 2e-3f;
    int x0 = max(0, (int)ceilf(fmaxf(left - margin, -1.f)));
    int x1 = min(t.width - 1, (int)floorf(fminf(right + margin, TILE)));
    int y0 = max(0, (int)ceilf(fmaxf(top - margin, -1.f)));
    int y1 = min(t.height - 1, (int)floorf(fminf(bottom + margin, TILE)));
    if (x1 < x0 || y1 < y0) return make_int4(0, 0, 0, 0);
    float area = fabsf((b.x - a.x) * (c.y - a.y) - (c.x - a.x) * (b.y - a.y)), across = right - left, down = bottom - top;
    int width = x1 - x0 + 1, height = y1 - y0 + 1;
    // what rounding may do to a depth is about 1e-7 times squared length over area, times the triangle's depth
    exactly = width * height >= LARGE_PX
        || (across * across + down * down) * (largest - smallest) > SLENDER_M * area * smallest * largest;
    return make_int4(x0, y0, width, height);
}

// One pixel of a small triangle. The products are rounded alike for both triangles at an edge: no cracks.
__device__ __forceinline__ void draw_pixel(
    const Buffers& buffers, const float4* corners, u32 triangle, int x, int y, u32 word
) {
    float4 a = corners[triangle & 255], b = corners[(triangle >> 8) & 255], c = corners[(triangle >> 16) & 255];
    float px = (float)x, py = (float)y;
    float ax = a.x - px, ay = a.y - py, bx = b.x - px, by = b.y - py, cx = c.x - px, cy = c.y - py;
    float ea = __fsub_rn(__fmul_rn(bx, cy), __fmul_rn(by, cx));
    float eb = __fsub_rn(__fmul_rn(cx, ay), __fmul_rn(cy, ax));
    float ec = __fsub_rn(__fmul_rn(ax, by), __fmul_rn(ay, bx));
    bool inside = (fminf(fminf(ea, eb), ec) >= 0.f) | (fmaxf(fmaxf(ea, eb), ec) <= 0.f);
    float sum = ea + eb + ec;
    if (inside && sum != 0.f) blend(buffers, x, y, __fdividef(sum, ea * a.z + eb * b.z + ec * c.z), word);
}

// A cluster by one warp.
__device__ __forceinline__ void draw_cluster(
    const Buffers& buffers, const Tile& t, const float* placement, const float* vertices, int vertex_count,
    const u32* triangles, int triangle_count, Scratch& scratch, u32 first_word, int lane, CutOut holes
) {
    __syncwarp();
    {
        float m[12];
        load_placement(placement, m);
        for (int i = lane; i < vertex_count; i += 32) {
            float vx = vertices[3 * i], vy = vertices[3 * i + 1], vz = vertices[3 * i + 2];
            float x = m[0] * vx + m[1] * vy + m[2] * vz + m[3];
            float y = m[4] * vx + m[5] * vy + m[6] * vz + m[7];
            float z = m[8] * vx + m[9] * vy + m[10] * vz + m[11];
            float inverse = fast_inverse(z);
            // pixel centres become whole numbers
            scratch.corners[i] = make_float4(x * inverse + (t.cx - 0.5f), y * inverse + (t.cy - 0.5f),
                                             z >= NEAR_M ? inverse : z > 0.f ? TOO_NEAR : BEHIND, 0.f);
        }
    }
    __syncwarp();
    int pairs[2];
    bool exact[2];
#pragma unroll
    for (int r = 0; r < 2; r++) {
        int i = r * 32 + lane;
        pairs[r] = 0;
        exact[r] = false;
        if (i < triangle_count) {
            u32 triangle = triangles[i];
            int4 b = set_up(scratch.corners, triangle, t, exact[r]);
            scratch.triangles[i] = make_uint2(triangle, b.x | b.y << 8 | b.z << 16 | b.w << 24);
            if (HOLES && holes.tables) exact[r] = b.z * b.w > 0;
            if (!exact[r]) pairs[r] = b.z * b.w;
        }
    }
    __syncwarp();
    int own = pairs[0] + pairs[1];
    if (__any_sync(FULL, own)) {
        int upto = own;
#pragma unroll
        for (int step = 1; step < 32; step <<= 1) {
            int before = __shfl_up_sync(FULL, upto, step);
            if (lane >= step) upto += before;
        }
        int total = __shfl_sync(FULL, upto, 31), first = upto - pairs[1];  // the second triangle's pairs begin there
        for (int start = 0; start < total; start += 32) {
            int pair = start + lane, owner = 0;
#pragma unroll
            for (int step = 16; step; step >>= 1)  // the first lane whose pairs go beyond this one
                if (__shfl_sync(FULL, upto, owner + step - 1) <= pair) owner += step;
            owner = min(owner, 31);
            int k = pair - __shfl_sync(FULL, first, owner), before = __shfl_sync(FULL, pairs[0], owner);
            if (pair < total) {
                int number = owner + 32;
                if (k < 0) {
                    k += before;
                    number = owner;
                }
                uint2 chosen = scratch.triangles[number];
                int width = (chosen.y >> 16) & 255, y = row_of(k, fast_inverse((float)width)), x = k - y * width;
                draw_pixel(buffers, scratch.corners, chosen.x, x + (chosen.y & 255), y + ((chosen.y >> 8) & 255),
                           first_word + number);
            }
        }
    }
    for (int r = 0; r < 2; r++)
        if (__any_sync(FULL, exact[r])) {
            if (HOLES && holes.tables)
                draw_exactly(buffers, t.cx, t.cy, placement, vertices, scratch.triangles, exact[r], r * 32 + lane,
                             first_word, lane, holes);
            else
                draw_exactly(buffers, t.cx, t.cy, placement, vertices, scratch.triangles, exact[r], r * 32 + lane,
                             first_word, lane, NoHoles());
        }
}

