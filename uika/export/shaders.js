// Gaussians on a mesh: posed and projected at the vertices of a quad, and shaded by distance from their centre.
const VERTEX_SHADER = `#version 300 es
  precision highp float; precision highp int; precision highp sampler2D; precision highp usampler2D;
  uniform sampler2D mesh;      // two texels a vertex: position and growth, rotation (wxyz)
  uniform usampler2D corners;  // three vertex numbers a splat
  uniform sampler2D still;     // two texels a splat: barycentric x y and offset x y, offset z and size
  uniform sampler2D turn;      // rotation (wxyz)
  uniform sampler2D paint;
  uniform mat4 view; uniform vec2 focal; uniform vec2 size;
  in uint index;
  out vec4 color; out vec3 conic; out vec2 away;
  ivec2 at(int i, int width) { return ivec2(i % width, i / width); }
  vec3 rotate(vec4 q, vec3 v) { vec3 t = 2.0 * cross(q.yzw, v); return v + q.x * t + cross(q.yzw, t); }
  vec4 times(vec4 p, vec4 q) {
    return vec4(p.x * q.x - dot(p.yzw, q.yzw), p.x * q.yzw + q.x * p.yzw + cross(p.yzw, q.yzw));
  }
  void main() {
    gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
    int i = int(index);
    uvec3 c = texelFetch(corners, at(i, 1024), 0).xyz;
    vec4 s0 = texelFetch(still, at(2 * i, 1024), 0);
    vec4 s1 = texelFetch(still, at(2 * i + 1, 1024), 0);
    vec3 weight = vec3(s0.xy, 1.0 - s0.x - s0.y);
    vec4 place = vec4(0.0), spin = vec4(0.0);
    for (int k = 0; k < 3; k++) {
      int v = 2 * int(c[k]);
      place += weight[k] * texelFetch(mesh, at(v, 1024), 0);
      spin += weight[k] * texelFetch(mesh, at(v + 1, 1024), 0);
    }
    spin = normalize(spin);
    vec3 mean = place.xyz + rotate(spin, vec3(s0.zw, s1.x));
    vec3 p = (view * vec4(mean, 1.0)).xyz;
    if (p.z < 0.01) return;
    vec3 scale = place.w * s1.yzw;
    vec4 q = times(spin, texelFetch(turn, at(i, 1024), 0));
    mat3 axes = mat3(view) * mat3(rotate(q, vec3(scale.x, 0, 0)), rotate(q, vec3(0, scale.y, 0)), rotate(q, vec3(0, 0, scale.z)));
    mat3 covariance = axes * transpose(axes);
    vec3 jx = vec3(focal.x / p.z, 0.0, -focal.x * p.x / (p.z * p.z));
    vec3 jy = vec3(0.0, focal.y / p.z, -focal.y * p.y / (p.z * p.z));
    float xx = dot(jx, covariance * jx) + 0.3, xy = dot(jx, covariance * jy), yy = dot(jy, covariance * jy) + 0.3;
    float det = xx * yy - xy * xy;
    if (det <= 0.0) return;
    color = texelFetch(paint, at(i, 1024), 0);
    float reach = 2.0 * log(255.0 * color.a);
    if (reach <= 0.0) return;
    conic = vec3(yy, -xy, xx) / det;
    vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.0 - 1.0;
    away = corner * ceil(sqrt(reach * vec2(xx, yy)) + 0.5);
    vec2 pixel = focal * p.xy / p.z + away;
    gl_Position = vec4(2.0 * pixel.x / size.x, -2.0 * pixel.y / size.y, 0.0, 1.0);
  }`;
const FRAGMENT_SHADER = `#version 300 es
  precision highp float;
  in vec4 color; in vec3 conic; in vec2 away; out vec4 result;
  void main() {
    float s = 0.5 * (conic.x * away.x * away.x + conic.z * away.y * away.y) + conic.y * away.x * away.y;
    float alpha = min(0.999, color.a * exp(-s));
    if (s < 0.0 || alpha < 1.0 / 255.0) discard;
    result = vec4(color.rgb * alpha, alpha);
  }`;
