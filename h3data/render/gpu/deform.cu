// What moves: matrices to camera space, and deformable meshes in cluster order together with their boxes.

struct Deform {
    World world;
    const float* joints;        // [worlds, bodies, joint_count, 12], joint to world
    const float* inverse_bind;  // [scenes, bodies, joint_count, 16]
    const uchar4* skin_joints;  // per pool vertex
    const float4* skin_weights;
    const float* sources;       // [worlds, source_count, 3], vertices that are given outright
    const int* source_vertex;   // per pool vertex: row behind the group's `first_source`
    int bodies, joint_count, source_count, unused;
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

// One block per (world, group). Joints that are NaN make empty boxes, which nothing ever sees.
extern "C" __global__ void __launch_bounds__(256, 5) deform(Deform d) {
    extern __shared__ float4 palette[];  // [joint_count, 3]: rows
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
        const float* joints = d.joints + ((size_t)world * d.bodies + group.body) * d.joint_count * 12;
        const float* bind = d.inverse_bind
            + ((size_t)s.scene_of_world[world] * d.bodies + group.body) * d.joint_count * 16;
        for (int i = threadIdx.x; i < d.joint_count * 12; i += blockDim.x) {
            const float *row = joints + i / 4 * 4, *column = bind + i / 12 * 16 + i % 4;
            ((float*)palette)[i] = row[0] * column[0] + row[1] * column[4] + row[2] * column[8] + row[3] * column[12];
        }
    }
    __syncthreads();
    const float* source = d.sources + ((size_t)world * d.source_count + (skinned ? 0 : group.first_source)) * 3;
    float* deformed = s.deformed + ((size_t)world * s.deformed_vertices - scene.first_vertex) * 3;
    for (int c = group.first_cluster + warp; c < group.first_cluster + group.clusters; c += warps) {
        const Box& rest = s.clusters[c];
        int count = bits(rest.center.w) & 0xffff, first = bits(rest.half.w);
        float low[3] = {1e30f, 1e30f, 1e30f}, high[3] = {-1e30f, -1e30f, -1e30f};
        for (int v = first + lane; v < first + count; v += 32) {
            float p[3] = {0, 0, 0};
            if (skinned) {
                const float* x = s.vertices + 3 * (size_t)v;
                uchar4 j = d.skin_joints[v];
                float4 weight = d.skin_weights[v];
                int joint[4] = {j.x, j.y, j.z, j.w};
                float w[4] = {weight.x, weight.y, weight.z, weight.w};
                for (int k = 0; k < 4; k++) {
                    if (w[k] == 0.f) continue;
                    const float4* m = palette + 3 * joint[k];
                    for (int a = 0; a < 3; a++)
                        p[a] += w[k] * (m[a].x * x[0] + m[a].y * x[1] + m[a].z * x[2] + m[a].w);
                }
            } else {
                const float* x = source + 3 * (size_t)d.source_vertex[v];
                for (int a = 0; a < 3; a++) p[a] = x[a];
            }
            for (int a = 0; a < 3; a++) {
                deformed[3 * (size_t)v + a] = p[a];
                low[a] = fminf(low[a], p[a]);
                high[a] = fmaxf(high[a], p[a]);
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
