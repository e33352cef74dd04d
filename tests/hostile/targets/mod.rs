//! Every decoder of bytes from outside, as a function of bytes. `fuzz/` runs the same table under libFuzzer.

pub(crate) mod alignment;
mod module;
pub(crate) mod scene;
pub(crate) mod state;
pub(crate) mod trust;
mod wire;

/// What a decoder made of some bytes: it took them, or it says why not.
pub(crate) type Verdict = Result<(), String>;

/// A decoder, and what it may cost.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Target {
    /// Its name, which is that of its corpus folder and of its fuzz target.
    pub(crate) name: &'static str,
    /// The decoder.
    pub(crate) decode: fn(&[u8]) -> Verdict,
    /// Most memory that it may hold at a time for each byte of its input, in bytes. What decoders build is larger than what
    /// they read: an empty protobuf message takes two bytes on the wire and some hundred in memory.
    pub(crate) bytes_per_byte: usize,
    /// Inputs made of each corpus file by the replay; fewer where one decode costs a system call or a signature.
    pub(crate) mutations: usize,
}

/// Memory for each byte of input unless a target says otherwise, in bytes.
const BYTES_PER_BYTE: usize = 64;
/// Inputs made of each corpus file unless a target says otherwise.
const MUTATIONS: usize = 1_500;

const fn target(name: &'static str, decode: fn(&[u8]) -> Verdict) -> Target {
    Target { name, decode, bytes_per_byte: BYTES_PER_BYTE, mutations: MUTATIONS }
}

const fn slow(name: &'static str, mutations: usize, decode: fn(&[u8]) -> Verdict) -> Target {
    Target { mutations, ..target(name, decode) }
}

const fn roomy(name: &'static str, bytes_per_byte: usize, decode: fn(&[u8]) -> Verdict) -> Target {
    Target { bytes_per_byte, ..target(name, decode) }
}

/// All of them.
pub(crate) const TARGETS: &[Target] = &[
    // Data plane.
    target("frames_to_node", wire::frames_to_node),
    target("frames_to_app", wire::frames_to_app),
    target("job_program", wire::job_program),
    target("packed_programs", wire::packed_programs),
    // Control plane: an empty message takes two bytes on the wire and up to 150 B in memory.
    roomy("app_to_coordinator", 128, wire::app_to_coordinator),
    roomy("coordinator_to_app", 128, wire::coordinator_to_app),
    roomy("node_to_coordinator", 128, wire::node_to_coordinator),
    roomy("coordinator_to_node", 128, wire::coordinator_to_node),
    // An empty node is two bytes on the wire, and in memory a structure with its cache's figures.
    roomy("farm_status", 192, wire::farm_status),
    roomy("timeline_head", 128, wire::timeline_head),
    roomy("timeline_segments", 128, wire::timeline_segments),
    // Plug-ins' pipes.
    target("plugin_question", wire::plugin_question),
    target("plugin_answer", wire::plugin_answer),
    // Trust.
    target("join_token", trust::join_token),
    target("principal", trust::principal),
    target("certificate", trust::certificate),
    slow("membership", 500, trust::membership),
    slow("signing_request", 500, trust::signing_request),
    slow("capability", 1_000, trust::capability),
    slow("identity_file", 500, trust::identity_file),
    slow("authority_file", 500, trust::authority_file),
    // The coordinator's state.
    slow("control_store", 150, state::control_store),
    slow("epoch_file", 50, state::epoch_file),
    // What an application keeps of a run.
    slow("run_journal", 400, state::run_journal),
    // Scenes.
    Target { bytes_per_byte: 128, ..slow("scene_toml", 400, scene::description) },
    slow("scene_obj", 400, scene::geometry),
    slow("scene_mtl", 400, scene::library),
    // Alignments and sums.
    roomy("alignment", 160, alignment::any_format),
    roomy("alignment_fasta", 160, alignment::fasta),
    roomy("alignment_a2m", 160, alignment::a2m),
    roomy("alignment_a3m", 160, alignment::a3m),
    roomy("alignment_stockholm", 160, alignment::stockholm),
    roomy("alignment_clustal", 160, alignment::clustal),
    roomy("alignment_plain", 160, alignment::plain),
    target("saved_sums", alignment::saved_sums),
    // Results of jobs.
    target("mi_result", alignment::result),
    target("render_result", scene::result),
    // Devices.
    target("device_spec", module::device_spec),
    // naga's tree, and the validator's tables over it.
    Target { bytes_per_byte: 512, ..slow("wgsl_module", 300, module::wgsl) },
];

/// The target of a name.
///
/// # Panics
/// There is none.
#[must_use]
pub(crate) fn named(name: &str) -> Target {
    *TARGETS.iter().find(|target| target.name == name).unwrap_or_else(|| panic!("no target is called {name}"))
}

/// The text of a decoder's refusal.
fn refused(error: impl std::fmt::Display) -> String {
    error.to_string()
}

/// The bytes as text; what is not UTF-8 does not reach decoders of text.
fn text(bytes: &[u8]) -> Result<&str, String> {
    std::str::from_utf8(bytes).map_err(refused)
}
