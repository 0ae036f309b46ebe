// What moves: matrices to camera space, and deformable meshes in cluster order together with their boxes.

struct Deform {
    World world;
    const float* joints;        // [worlds, bodies, joint_count, joint_words], joint to world
    const float* inverse_bind;  // [scenes, bodies, joint_count, 16]
    float4* palettes;           // [worlds, bodies, joint_count, 3]: rows of the matrices, rest to world
    const uchar4* skin_joints;  // per pool vertex
    const float4* skin_weights;
    const float* sources;       // [worlds, source_count, 3], vertices that are given outright
    const int* source_vertex;   // per pool vertex: row behind the group's `first_source`
    int worlds, bodies, joint_count, joint_words, source_count, unused;
};

extern "C" __global__ void place(World s) {
    int k = blockIdx.x * blockDim.x + threadIdx.x;
    if (k >= s.views * s.slots) return;
    int view = s.first_view + k / s.slots, slot = k % s.slots;
    const float* camera = s.cameras + CAMERA_WORDS * (size_t)view;
    const float* pose = s.poses + ((size_t)s.world_of_view[view] * (s.slots - 1) + slot - 1) * 12;
    float* out = s.placement + ((size_t)view * s.slots + slot) * 12;
    for (int c = 0; c < 4; c++) {
        double p[3];
        for (int a = 0; a < 3; a++) {
            p[a] = slot ? pose[4 * a + c] : (a == c ? 1.0 : 0.0);
            if (c == 3) p[a] -= camera[4 * a + 3];
        }
        for (int r = 0; r < 3; r++) {
            double x = camera[r] * p[0] + camera[4 + r] * p[1] + camera[8 + r] * p[2];
            out[4 * r + c] = (float)(r < 2 ? x * s.scale * camera[12 + r] : x);
        }
    }
}

// Order-preserving integers of floats, for atomics.
__device__ __forceinline__ int ordered(float x) { int i = bits(x); return i ^ ((i >> 31) & 0x7fffffff); }
__device__ __forceinline__ float unordered(int i) { return __int_as_float(i ^ ((i >> 31) & 0x7fffffff)); }

__device__ __forceinline__ Box box_of(const float* low, const float* high, int first, int second) {
    Box b;
    const float margin = 2e-5f;
    b.center = make_float4(0.5f * (low[0] + high[0]), 0.5f * (low[1] + high[1]), 0.5f * (low[2] + high[2]),
                           __int_as_float(first));
    b.half = make_float4(0.5f * (high[0] - low[0]) + margin, 0.5f * (high[1] - low[1]) + margin,
                         0.5f * (high[2] - low[2]) + margin, __int_as_float(second));
    return b;
}

// The matrices that skin, one row a thread.
extern "C" __global__ void palette(Deform d) {
    int k = blockIdx.x * blockDim.x + threadIdx.x, joint = k / 3, of_world = d.bodies * d.joint_count;
    if (joint >= d.worlds * of_world) return;
    float4 row = *(const float4*)(d.joints + (size_t)joint * d.joint_words + k % 3 * 4);
    int scene = d.world.scene_of_world[joint / of_world];
    const float4* bind = (const float4*)(d.inverse_bind + ((size_t)scene * of_world + joint % of_world) * 16);
    float4 a = bind[0], b = bind[1], c = bind[2], e = bind[3];
    d.palettes[k] = make_float4(row.x * a.x + row.y * b.x + row.z * c.x + row.w * e.x,
                                row.x * a.y + row.y * b.y + row.z * c.y + row.w * e.y,
                                row.x * a.z + row.y * b.z + row.z * c.z + row.w * e.z,
                                row.x * a.w + row.y * b.w + row.z * c.w + row.w * e.w);
}

// p += weight * (matrix * x); what has no weight may be NaN.
__device__ __forceinline__ void add_weighted(const float4* matrix, float weight, const float* x, float* p) {
    if (weight == 0.f) return;
    for (int a = 0; a < 3; a++) {
        float4 row = matrix[a];
        p[a] += weight * (row.x * x[0] + row.y * x[1] + row.z * x[2] + row.w);
    }
}

// One block per (world, group). Joints that are NaN make empty boxes, which nothing ever sees.
extern "C" __global__ void __launch_bounds__(128, 12) deform(Deform d) {
    extern __shared__ float4 matrices[];  // [joint_count, 3]: rows
    __shared__ int group_low[3], group_high[3];
    const World& s = d.world;
    int world = blockIdx.x / s.deformed_group_count, g = blockIdx.x % s.deformed_group_count;
    const Scene& scene = s.scenes[s.scene_of_world[world]];
    if (g >= scene.groups) return;
    const Group group = s.groups[scene.first_group + g];
    int lane = threadIdx.x & 31, warp = threadIdx.x >> 5, warps = blockDim.x >> 5;
    bool skinned = group.first_source < 0;
    if (threadIdx.x < 3) {
        group_low[threadIdx.x] = ordered(1e30f);
        group_high[threadIdx.x] = ordered(-1e30f);
    }
    if (skinned) {
        const float4* from = d.palettes + ((size_t)world * d.bodies + group.body) * d.joint_count * 3;
        for (int i = threadIdx.x; i < d.joint_count * 3; i += blockDim.x) matrices[i] = from[i];
    }
    __syncthreads();
    const float* source = d.sources + ((size_t)world * d.source_count + (skinned ? 0 : group.first_source)) * 3;
    float* deformed = s.deformed + ((size_t)world * s.deformed_vertices - scene.first_vertex) * 3;
    for (int c = group.first_cluster + warp; c < group.first_cluster + group.clusters; c += warps) {
        const Box& rest = s.clusters[c];
        int count = bits(rest.center.w) & 0xffff, first = bits(rest.half.w);
        float low[3] = {1e30f, 1e30f, 1e30f}, high[3] = {-1e30f, -1e30f, -1e30f};
        int last = first + count - 1;
        for (int start = first + lane; start - lane <= last; start += 64) {  // two a lane, so that their loads overlap
            int v[2] = {min(start, last), min(start + 32, last)};
            float p[2][3] = {};
            if (skinned) {
                float x[2][3];
                uchar4 joints[2];
                float4 weights[2];
#pragma unroll
                for (int r = 0; r < 2; r++) {
                    for (int a = 0; a < 3; a++) x[r][a] = s.vertices[3 * (size_t)v[r] + a];
                    joints[r] = d.skin_joints[v[r]];
                    weights[r] = d.skin_weights[v[r]];
                }
#pragma unroll
                for (int r = 0; r < 2; r++) {
                    add_weighted(matrices + 3 * joints[r].x, weights[r].x, x[r], p[r]);
                    add_weighted(matrices + 3 * joints[r].y, weights[r].y, x[r], p[r]);
                    add_weighted(matrices + 3 * joints[r].z, weights[r].z, x[r], p[r]);
                    add_weighted(matrices + 3 * joints[r].w, weights[r].w, x[r], p[r]);
                }
            } else {
                for (int r = 0; r < 2; r++)
                    for (int a = 0; a < 3; a++) p[r][a] = source[3 * (size_t)d.source_vertex[v[r]] + a];
            }
#pragma unroll
            for (int r = 0; r < 2; r++)
                for (int a = 0; a < 3; a++) {
                    deformed[3 * (size_t)v[r] + a] = p[r][a];
                    low[a] = fminf(low[a], p[r][a]);
                    high[a] = fmaxf(high[a], p[r][a]);
                }
        }
        for (int a = 0; a < 3; a++) {
            low[a] = unordered(__reduce_min_sync(FULL, ordered(low[a])));
            high[a] = unordered(__reduce_max_sync(FULL, ordered(high[a])));
        }
        if (lane == 0) {
            size_t at = (size_t)world * s.deformed_cluster_count + c - scene.first_cluster;
            s.deformed_clusters[at] = box_of(low, high, bits(rest.center.w), first);
            for (int a = 0; a < 3; a++) {
                atomicMin(group_low + a, ordered(low[a]));
                atomicMax(group_high + a, ordered(high[a]));
            }
        }
    }
    __syncthreads();
    if (threadIdx.x == 0) {
        float low[3], high[3];
        for (int a = 0; a < 3; a++) low[a] = unordered(group_low[a]), high[a] = unordered(group_high[a]);
        s.deformed_groups[(size_t)world * s.deformed_group_count + g]
            = box_of(low, high, group.first_cluster, group.clusters);
    }
}
