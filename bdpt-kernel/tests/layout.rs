//! The WGSL text is valid, and its structs, bindings and constants are those of the Rust side.
#![allow(clippy::cast_possible_truncation, reason = "offsets in small structs")]

use std::mem::{offset_of, size_of};

use bdpt_kernel::gpu::{
    layout::{self, binding},
    module, module_source,
};
use naga::{
    AddressSpace, Expression, Literal, Module, TypeInner,
    valid::{Capabilities, ValidationFlags, Validator},
};

fn parse() -> Module {
    naga::front::wgsl::parse_str(module_source()).unwrap_or_else(|error| {
        let place = error.location(module_source()).and_then(|l| module().locate(l.offset as usize));
        panic!("{place:?}: {}", error.emit_to_string(module_source()))
    })
}

/// Offsets of a WGSL struct's members by name, and its size.
fn wgsl_struct(module: &Module, name: &str) -> (Vec<(String, u32)>, u32) {
    let (_, found) = module
        .types
        .iter()
        .find(|(_, t)| t.name.as_deref() == Some(name))
        .unwrap_or_else(|| panic!("no struct {name}"));
    let TypeInner::Struct { members, span } = &found.inner else { panic!("{name} is no struct") };
    let members = members.iter().map(|m| (m.name.clone().expect("members have names"), m.offset)).collect();
    (members, *span)
}

macro_rules! assert_same_layout {
    ($module:expr, $type:ident { $($field:ident),+ $(,)? }) => {{
        let (members, size) = wgsl_struct($module, stringify!($type));
        let rust = vec![$((stringify!($field).to_owned(), offset_of!(layout::$type, $field) as u32)),+];
        let named: Vec<_> = members.into_iter().filter(|(name, _)| !name.starts_with("padding")).collect();
        assert_eq!(named, rust, "members of {}", stringify!($type));
        assert_eq!(size as usize, size_of::<layout::$type>(), "size of {}", stringify!($type));
    }};
}

#[test]
fn the_module_is_valid() {
    let parsed = parse();
    let mut validator = Validator::new(ValidationFlags::all(), Capabilities::empty());
    if let Err(error) = validator.validate(&parsed) {
        panic!("{}", error.emit_to_string(module_source()));
    }
}

#[test]
fn structs_lie_as_in_rust() {
    let parsed = parse();
    assert_same_layout!(&parsed, Shading { normals, material });
    assert_same_layout!(&parsed, Material { reflectance, kind, emission, ior });
    assert_same_layout!(&parsed, Light { v0, alias_threshold, e1, alias_index, e2, kind, radiance, pl });
    assert_same_layout!(
        &parsed,
        Frame {
            eye,
            d_img,
            right,
            width_px,
            up,
            height_px,
            forward,
            nl,
            environment,
            environment_pl,
            center,
            radius,
            light_count,
            max_edges,
            connect,
            splat,
            splat_unit,
            roulette_edges,
            connection_threshold,
            area_pdf_scale,
            world_per_unit,
        }
    );
    assert_same_layout!(
        &parsed,
        Tile {
            x_px,
            y_px,
            width_px,
            height_px,
            first_sample,
            slots,
            seed_lo,
            seed_hi,
            scratch_lanes,
            first_hit_samples,
        }
    );
    assert_same_layout!(
        &parsed,
        LightRange { first_path_lo, first_path_hi, paths, groups_x, seed_lo, seed_hi }
    );
    assert_same_layout!(&parsed, SlotSum { rgb, luminance, luminance_squared, count, rays });
    assert_same_layout!(&parsed, FirstHitSum { albedo, samples, normal, depth, hits });
    assert_same_layout!(
        &parsed,
        Counters { traversals_cut, stack_overflows, non_finite, splat_overflows, paths_cut, rays }
    );
}

#[test]
#[should_panic(expected = "members of Light")]
fn a_moved_member_is_noticed() {
    let moved = module_source().replacen("alias_threshold: f32,", "", 1).replacen(
        "radiance: vec3<f32>,\n    pl: f32,",
        "radiance: vec3<f32>,\n    alias_threshold: f32,\n    pl: f32,",
        1,
    );
    let parsed = naga::front::wgsl::parse_str(&moved).expect("the moved text still parses");
    assert_same_layout!(&parsed, Light { v0, alias_threshold, e1, alias_index, e2, kind, radiance, pl });
}

#[test]
fn bindings_and_workgroups_are_those_of_rust() {
    let parsed = parse();
    let storage = |name: &str| {
        let (_, global) = parsed
            .global_variables
            .iter()
            .find(|(_, g)| g.name.as_deref() == Some(name))
            .unwrap_or_else(|| panic!("no global {name}"));
        assert!(matches!(global.space, AddressSpace::Storage { .. }), "{name} is a storage buffer");
        let place = global.binding.as_ref().expect("a storage buffer has a binding");
        assert_eq!(place.group, 0, "{name} lies in group 0");
        place.binding
    };
    let names = [
        ("nodes", binding::NODES),
        ("triangles", binding::TRIANGLES),
        ("shading", binding::SHADING),
        ("materials", binding::MATERIALS),
        ("lights", binding::LIGHTS),
        ("counters", binding::COUNTERS),
        ("vertex_a", binding::VERTEX_A),
        ("vertex_b", binding::VERTEX_B),
        ("vertex_c", binding::VERTEX_C),
        ("slot_sums", binding::SLOT_SUMS),
        ("pixel_sums", binding::PIXEL_SUMS),
        ("first_hits", binding::FIRST_HITS),
        ("splat_red", binding::SPLAT_RED),
        ("splat_green", binding::SPLAT_GREEN),
        ("splat_blue", binding::SPLAT_BLUE),
        ("splat_layer", binding::SPLAT_LAYER),
    ];
    for (name, expected) in names {
        assert_eq!(storage(name), expected, "binding of {name}");
    }
    for entry in &parsed.entry_points {
        assert_eq!(entry.workgroup_size, [layout::GROUP_LANES, 1, 1], "workgroup of {}", entry.name);
    }
    let entries: Vec<&str> = parsed.entry_points.iter().map(|e| e.name.as_str()).collect();
    assert_eq!(entries, ["eye", "light", "first_hit", "resolve_eye", "resolve_splat"]);
}

#[test]
fn constants_are_those_of_rust() {
    let parsed = parse();
    let constant = |name: &str| {
        let (_, constant) = parsed
            .constants
            .iter()
            .find(|(_, c)| c.name.as_deref() == Some(name))
            .unwrap_or_else(|| panic!("no constant {name}"));
        match parsed.global_expressions[constant.init] {
            Expression::Literal(Literal::U32(value)) => value,
            ref other => panic!("{name} is no u32 literal: {other:?}"),
        }
    };
    let pairs = [
        ("BLOCK_EDGE_PX", layout::BLOCK_EDGE_PX),
        ("GROUP_LANES", layout::GROUP_LANES),
        ("MAX_LIGHT_VERTICES", layout::MAX_LIGHT_VERTICES),
        ("FLAT", layout::FLAT),
        ("DIFFUSE", layout::DIFFUSE),
        ("MIRROR", layout::MIRROR),
        ("DIELECTRIC", layout::DIELECTRIC),
        ("AREA", layout::AREA),
        ("ENVIRONMENT", layout::ENVIRONMENT),
        ("STACK_SIZE", bdpt_kernel::gpu::pack::MAX_DEPTH),
    ];
    for (name, expected) in pairs {
        assert_eq!(constant(name), expected, "{name}");
    }
}
