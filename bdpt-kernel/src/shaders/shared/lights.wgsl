// Lights: one table of probabilities for light starts, s = 0 and s = 1 (50-bdpt.md section 2; trap 4).
// Twin: src/twin/lights.rs.

// Where a light subpath starts; all pdfs include the light's probability Pl.
struct Emission {
    origin: vec3<f32>,
    infinite: bool,
    direction: vec3<f32>,
    dvcm: f32,
    throughput: vec3<f32>,
    dvc: f32,
}

// A light sample seen from a surface (s = 1).
struct LightSample {
    // From the surface toward the light, unit.
    direction: vec3<f32>,
    // dirPdfW: pdf_solid_angle of the sample; 0 when the light shows its back.
    direct_pdf: f32,
    radiance: vec3<f32>,
    // emiPdf over cosL: what the recursion needs, with the cosine cancelled.
    emission_pdf_over_cos: f32,
    // A point light-side of the shadow ray, already offset; infinitely far when `infinite`.
    end: vec3<f32>,
    infinite: bool,
}

// A column of the alias table, then the column's own light or its alias.
fn pick_light(u: f32) -> u32 {
    let scaled = u * f32(frame.light_count);
    let column = min(u32(scaled), frame.light_count - 1u);
    let rest = scaled - f32(column);
    return select(lights[column].alias_index, column, rest < lights[column].alias_threshold);
}

fn environment_pdf() -> f32 {
    return frame.environment_pl * (1.0 / (4.0 * PI));
}

// emiPdf of the environment: a direction, then a point on the disk of the bounding sphere.
fn environment_emission_pdf() -> f32 {
    return environment_pdf() / (PI * frame.radius * frame.radius);
}

// dirPdfA of a point on an emitting triangle: Pl / A, and Pl is in proportion to luminance * A.
fn area_direct_pdf(emission: vec3<f32>) -> f32 {
    return luminance(emission) * frame.area_pdf_scale;
}

fn sample_emission(pick: f32, u: vec4<f32>) -> Emission {
    let light = lights[pick_light(pick)];
    if light.kind == ENVIRONMENT {
        let direction = -sample_sphere(u.xy);
        let disk = sample_disk(u.zw) * frame.radius;
        let origin = frame.center + to_world(direction, vec3<f32>(disk, -frame.radius));
        let disk_area = PI * frame.radius * frame.radius;
        let emission_pdf = light.pl * (1.0 / (4.0 * PI)) / disk_area;
        return Emission(origin, true, direction, disk_area, light.radiance / emission_pdf, 1.0 / emission_pdf);
    }
    let weights = sample_triangle(u.xy);
    let position = light.v0 + light.e1 * weights.x + light.e2 * weights.y;
    let normal = cross(light.e1, light.e2);
    let size = length(normal);
    let ng = normal / size;
    let local = sample_cosine_hemisphere(u.zw);
    let direction = to_world(ng, local);
    // area * pi / Pl, the inverse of emiPdf without its cosine.
    let inverse_pdf = 0.5 * size * PI / light.pl;
    let origin = offset_along(position, ng, ng);
    return Emission(origin, false, direction, PI / local.z, light.radiance * inverse_pdf, inverse_pdf);
}

fn sample_light(position: vec3<f32>, u: vec3<f32>) -> LightSample {
    let light = lights[pick_light(u.x)];
    if light.kind == ENVIRONMENT {
        let direction = sample_sphere(u.yz);
        return LightSample(
            direction,
            light.pl * (1.0 / (4.0 * PI)),
            light.radiance,
            environment_emission_pdf(),
            vec3<f32>(0.0),
            true,
        );
    }
    let weights = sample_triangle(u.yz);
    let end = light.v0 + light.e1 * weights.x + light.e2 * weights.y;
    let normal = cross(light.e1, light.e2);
    let size = length(normal);
    let ng = normal / size;
    let offset = end - position;
    let distance_squared = dot(offset, offset);
    let direction = offset / sqrt(distance_squared);
    let cos_light = -dot(direction, ng);
    let area_pdf = light.pl / (0.5 * size);
    let direct_pdf = select(0.0, area_pdf * distance_squared / cos_light, cos_light > 0.0 && distance_squared > 0.0);
    return LightSample(direction, direct_pdf, light.radiance, area_pdf / PI, offset_along(end, ng, ng), false);
}
