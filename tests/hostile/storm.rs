//! Inputs too large to keep, each made for one weakness: depth, counts, long lines, and quantities that multiply.

/// Nesting that overflows a stack if each level takes one.
const DEPTH: usize = 100_000;
/// Levels that a module may have.
const WITHIN: usize = 1_900;
/// Digits, letters or lines: past every bound on a name, within every bound on a file.
const MANY: usize = 1_000_000;

/// A large input for a target.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Storm {
    /// Which target.
    pub(crate) target: &'static str,
    /// What is large.
    pub(crate) what: &'static str,
    /// Makes it.
    pub(crate) make: fn() -> Vec<u8>,
}

const fn storm(target: &'static str, what: &'static str, make: fn() -> Vec<u8>) -> Storm {
    Storm { target, what, make }
}

fn scene(further: &str) -> Vec<u8> {
    format!("{further}\n{}", String::from_utf8_lossy(crate::targets::scene::DESCRIPTION)).into_bytes()
}

fn geometry(further: &str) -> Vec<u8> {
    format!("{}\n{further}", String::from_utf8_lossy(crate::targets::scene::GEOMETRY)).into_bytes()
}

fn library(further: &str) -> Vec<u8> {
    format!("{}\n{further}", String::from_utf8_lossy(crate::targets::scene::LIBRARY)).into_bytes()
}

fn lines(count: usize, line: impl Fn(usize) -> String) -> String {
    (0..count).map(line).collect()
}

fn module(expression: &str) -> Vec<u8> {
    format!("@compute @workgroup_size(1) fn main() {{ let x = {expression}; }}").into_bytes()
}

/// A sequence of DER that holds one that holds one...
fn nested_der() -> Vec<u8> {
    let mut bytes = Vec::new();
    for _ in 0..DEPTH / 10 {
        let length = u32::try_from(bytes.len()).unwrap_or(u32::MAX).to_be_bytes();
        bytes.splice(0..0, [&[0x30, 0x84][..], &length].concat());
    }
    bytes
}

/// A protobuf field of a length, over and over, each within the one before.
fn nested_fields() -> Vec<u8> {
    let mut bytes = Vec::new();
    for _ in 0..DEPTH / 10 {
        let mut length = bytes.len();
        let mut head = vec![0x0a];
        while length > 0x7f {
            head.push(0x80 | u8::try_from(length & 0x7f).unwrap_or(0));
            length >>= 7;
        }
        head.push(u8::try_from(length).unwrap_or(0));
        bytes.splice(0..0, head);
    }
    bytes
}

fn pem(kind: &str, der: &[u8]) -> Vec<u8> {
    const ALPHABET: &[u8] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut text = format!("-----BEGIN {kind}-----\n").into_bytes();
    for chunk in der.chunks(3) {
        let word = chunk
            .iter()
            .chain([0; 3].iter())
            .take(3)
            .fold(0_usize, |word, byte| word << 8 | usize::from(*byte));
        text.extend([18, 12, 6, 0].map(|shift| ALPHABET[word >> shift & 63]));
    }
    text.extend(format!("\n-----END {kind}-----\n").bytes());
    text
}

/// A binary length that is far over what follows: `253` announces a `u64`, `252` a `u32`.
fn claimed(before: &[u8], claimed: u32, behind: usize) -> Vec<u8> {
    [before, &[252], &claimed.to_le_bytes(), &vec![1; behind]].concat()
}

pub(crate) const STORMS: &[Storm] = &[
    storm("run_journal", "marks of records without records", || {
        let header = &include_bytes!("../../fuzz/corpus/run_journal/valid-three")[..44];
        [header, &b"\x89record\n".repeat(MANY / 8)].concat()
    }),
    storm("frames_to_node", "frames without end", || vec![0; MANY]),
    storm("frames_to_node", "a frame of tickets that are not there", || {
        let header = claimed(&[1], 1 << 20, 300_000);
        let length = u32::try_from(header.len()).unwrap_or(0).to_le_bytes();
        [&length[..], &[0; 8], &header].concat()
    }),
    storm("frames_to_app", "a frame of sections that are not there", || {
        let header = claimed(&[1, 0, 0, 0, 0, 0, 0, 0, 0], u32::MAX, 300_000);
        let length = u32::try_from(header.len()).unwrap_or(0).to_le_bytes();
        [&length[..], &[0; 8], &header].concat()
    }),
    storm("job_program", "commands of three bytes", || {
        [&[252][..], &300_000_u32.to_le_bytes(), &vec![0; 900_000]].concat()
    }),
    storm("job_program", "bytes that are not there, behind 5 kB that are", || {
        claimed(&[3, 4, 0, 0, 1, 1, 4, 0, 0], 3 << 20, 5_000)
    }),
    storm("job_program", "bytes that are not there, behind 260 kB that are", || {
        claimed(&[1, 4, 0, 0], 200 << 20, 260 << 10)
    }),
    storm("packed_programs", "programs of no bytes", || [&[0xff, 0xff][..], &vec![0; 4 * 65_535]].concat()),
    storm("app_to_coordinator", "messages in messages", nested_fields),
    storm("node_to_coordinator", "messages in messages", nested_fields),
    storm("node_to_coordinator", "groups in groups", || vec![0x0b; DEPTH]),
    storm("coordinator_to_app", "empty nodes of a plan", || {
        let nodes = [0x12, 0].repeat(200_000);
        [&[0x1a][..], &[0x80, 0xb5, 0x18], &nodes].concat()
    }),
    storm("farm_status", "empty nodes", || [0x12, 0].repeat(300_000)),
    storm("timeline_segments", "runs without jobs", || {
        [&[0x0a, 0xc0, 0xcf, 0x24][..], &[0x0a, 0].repeat(300_000)].concat()
    }),
    storm("plugin_question", "lists in lists", || vec![b'['; DEPTH]),
    storm("plugin_answer", "lists in lists", || [&b"{\"Ok\":"[..], &vec![b'['; DEPTH]].concat()),
    storm("plugin_answer", "objects in objects", || b"{\"Ok\":".repeat(DEPTH)),
    storm("join_token", "a line of a million digits", || [&b"gleaner-join-"[..], &vec![b'a'; MANY]].concat()),
    storm("join_token", "a million lines", || vec![b'\n'; MANY]),
    storm("principal", "a name of a million letters", || {
        [&b"gleaner://farm/app/"[..], &vec![b'a'; MANY]].concat()
    }),
    storm("principal", "a million parts", || [&b"gleaner://"[..], &vec![b'/'; MANY]].concat()),
    storm("certificate", "sequences in sequences", nested_der),
    storm("membership", "sequences in sequences", nested_der),
    storm("signing_request", "sequences in sequences", nested_der),
    storm("capability", "a megabyte", || vec![0x0a; MANY]),
    storm("identity_file", "sequences in sequences", || pem("CERTIFICATE", &nested_der())),
    storm("identity_file", "a key without end", || b"-----BEGIN PRIVATE KEY-----\n".repeat(2_000)),
    storm("identity_file", "certificates of nothing", || {
        b"-----BEGIN CERTIFICATE-----\n-----END CERTIFICATE-----\n".repeat(1_000)
    }),
    storm("authority_file", "a million letters", || vec![b'a'; MANY]),
    storm("epoch_file", "a number of a million digits", || vec![b'1'; MANY]),
    storm("scene_toml", "arrays in arrays", || scene(&format!("x = {}", "[".repeat(DEPTH)))),
    storm("scene_toml", "closed arrays in arrays", || {
        scene(&format!("x = {}{}", "[".repeat(DEPTH), "]".repeat(DEPTH)))
    }),
    storm("scene_toml", "tables in tables", || scene(&format!("x = {}", "{a=".repeat(DEPTH)))),
    storm("scene_toml", "a key of a hundred thousand parts", || {
        scene(&format!("{}a = 1", "a.".repeat(DEPTH)))
    }),
    storm("scene_toml", "a table of a hundred thousand parts", || {
        [&scene("")[..], format!("\n[{}a]\n", "a.".repeat(DEPTH)).as_bytes()].concat()
    }),
    storm("scene_toml", "lights of a hundred thousand parts", || {
        [&scene("")[..], format!("\n[[light]]\n{}a = 1\n", "a.".repeat(DEPTH)).as_bytes()].concat()
    }),
    storm("scene_toml", "a hundred thousand materials", || {
        let materials = lines(DEPTH, |index| format!("\"{index}\" = {{type = \"diffuse\"}}\n"));
        [&scene("")[..], b"\n[materials]\n", materials.as_bytes()].concat()
    }),
    storm("scene_toml", "a hundred thousand materials, the last one wrong", || {
        let materials = lines(DEPTH, |index| format!("\"{index}\" = {{type = \"diffuse\"}}\n"));
        [&scene("")[..], b"\n[materials]\n", materials.as_bytes(), b"x = {type = \"no\"}"].concat()
    }),
    storm("scene_toml", "a material of a million letters", || {
        [&scene("")[..], format!("\n[materials.{}]\ntype = \"x\"\n", "m".repeat(MANY)).as_bytes()].concat()
    }),
    storm("scene_toml", "a key of a million letters", || scene(&format!("{} = 1", "k".repeat(MANY)))),
    storm("scene_toml", "a type of a million letters", || {
        [&scene("")[..], format!("\n[materials.m]\ntype = \"{}\"\n", "t".repeat(MANY)).as_bytes()].concat()
    }),
    storm("scene_toml", "a file of a million letters", || {
        format!("geometry = [\"{}.obj\"]\n[film]\nwidth=1\nheight=1\n[camera]\neye=[0,0,1]\ntarget=[0,0,0]\nup=[0,1,0]\nhfov_deg=9", "g".repeat(MANY)).into_bytes()
    }),
    storm("scene_toml", "the same file many times", || {
        let files = "\"a.obj\",".repeat(5_000);
        format!("geometry = [{files}]\n[film]\nwidth=1\nheight=1\n[camera]\neye=[0,0,1]\ntarget=[0,0,0]\nup=[0,1,0]\nhfov_deg=9").into_bytes()
    }),
    storm("scene_toml", "a string of a million letters", || scene(&format!("x = \"{}\"", "a".repeat(MANY)))),
    storm("scene_toml", "a number of a million digits", || scene(&format!("x = {}", "1".repeat(MANY)))),
    storm("scene_obj", "a library of a million letters", || {
        geometry(&format!("mtllib {}", "m".repeat(MANY)))
    }),
    storm("scene_obj", "a material of a million letters", || {
        geometry(&format!("usemtl {}\nf 1 2 3", "m".repeat(MANY)))
    }),
    storm("scene_obj", "an object of a million letters", || {
        geometry(&format!("o {}\nf 0 2 3", "m".repeat(MANY)))
    }),
    storm("scene_obj", "a statement of a million letters", || geometry(&"m".repeat(MANY))),
    storm("scene_obj", "a corner of a million letters", || geometry(&format!("f {}", "m".repeat(MANY)))),
    storm("scene_obj", "a face of a million corners", || geometry(&format!("f{}", " 1".repeat(MANY)))),
    storm("scene_obj", "a million relative corners", || geometry(&format!("f{}", " -1".repeat(MANY)))),
    storm("scene_obj", "indices past every count", || {
        geometry("f 1 2 99999999999999999999\nf 4294967295 4294967294 1")
    }),
    storm("scene_obj", "half a million groups", || geometry(&"g a\n".repeat(MANY / 2))),
    storm("scene_obj", "materials under a long name of an object", || {
        let uses = lines(2_000, |index| format!("usemtl m{index}\nf 1 2 3\n"));
        geometry(&format!("o {}\n{uses}", "n".repeat(MANY / 2)))
    }),
    storm("scene_obj", "a hundred thousand materials", || {
        geometry(&lines(DEPTH, |index| format!("usemtl m{index}\nf 1 2 3\n")))
    }),
    storm("scene_obj", "two materials by turns", || {
        geometry(&"usemtl light\nf 1 2 3\nusemtl grey\nf 1 2 3\n".repeat(20_000))
    }),
    storm("scene_obj", "the same library by many names", || {
        geometry(&lines(2_000, |count| format!("mtllib {}a.mtl\n", "./".repeat(count % 40))))
    }),
    storm("scene_obj", "points without faces", || geometry(&"v 0 0 0\n".repeat(100_000))),
    storm("scene_obj", "a number of a million digits", || geometry(&format!("v {} 0 0", "1".repeat(MANY)))),
    storm("scene_mtl", "warnings", || library(&format!("newmtl a\n{}", "Ni 0\n".repeat(200_000)))),
    storm("scene_mtl", "materials again and again", || library(&"newmtl a\n".repeat(100_000))),
    storm("scene_mtl", "textures", || library(&format!("newmtl a\n{}", "map_\n".repeat(200_000)))),
    storm("scene_mtl", "a name of a million letters", || {
        library(&format!("newmtl {}\nKd x", "a".repeat(MANY)))
    }),
    storm("alignment", "a million rows", || b"A\n".repeat(MANY)),
    storm("alignment", "names without residues", || b">\n".repeat(MANY)),
    storm("alignment", "a row of a million columns", || {
        let row = "A".repeat(MANY);
        format!(">a\n{row}\n>b\n{row}\n").into_bytes()
    }),
    storm("alignment_fasta", "a name of a million letters, out of step", || {
        format!(">{}\nA\n>{}\nAA\n", "a".repeat(MANY), "b".repeat(MANY)).into_bytes()
    }),
    storm("alignment_fasta", "a name of a million letters, alone", || {
        format!(">{}\nA\n", "a".repeat(MANY)).into_bytes()
    }),
    storm("alignment_fasta", "a name of a million letters, without residues", || {
        format!(">a\nA\n>{}\n", "a".repeat(MANY)).into_bytes()
    }),
    storm("alignment_fasta", "a name of a million letters, of too many columns", || {
        let row = "A".repeat(MANY / 10);
        format!(">{}\n{row}\n>b\n{row}\n", "a".repeat(MANY)).into_bytes()
    }),
    storm("alignment_a3m", "rows of insertions", || b">\na\n".repeat(MANY / 4)),
    storm("alignment_stockholm", "names of one letter", || {
        format!("# STOCKHOLM 1.0\n{}//\n", lines(200_000, |row| format!("{row:x} A\n"))).into_bytes()
    }),
    storm("alignment_clustal", "blocks without end", || {
        [&b"CLUSTAL W\n"[..], &b"a A\n".repeat(200_000)].concat()
    }),
    storm("alignment_plain", "blank lines", || b"\n".repeat(MANY)),
    storm("saved_sums", "iterations that are not there", || vec![0xff; 100]),
    storm("mi_result", "sections of nothing", || vec![0; MANY]),
    storm("render_result", "sections of nothing", || vec![0; MANY]),
    storm("device_spec", "settings without end", || [&b"sim:"[..], &b",".repeat(MANY)].concat()),
    storm("device_spec", "a number of a million digits", || [&b"gpu:"[..], &b"1".repeat(MANY)].concat()),
    storm("wgsl_module", "parentheses", || module(&format!("{}1{}", "(".repeat(DEPTH), ")".repeat(DEPTH)))),
    storm("wgsl_module", "open parentheses", || module(&"(".repeat(DEPTH))),
    storm("wgsl_module", "signs", || module(&format!("{}1", "-".repeat(DEPTH)))),
    storm("wgsl_module", "sums", || module(&format!("1{}", " + 1".repeat(DEPTH)))),
    storm("wgsl_module", "sums of calls", || {
        let sum = " + f()".repeat(DEPTH);
        format!(
            "fn f() -> u32 {{ return 1u; }}\n@compute @workgroup_size(1) fn main() {{ var x = f(){sum}; }}"
        )
        .into_bytes()
    }),
    storm("wgsl_module", "members of members", || module(&format!("a{}", ".a".repeat(DEPTH)))),
    storm("wgsl_module", "elements of elements", || module(&format!("a{}", "[0]".repeat(DEPTH)))),
    storm("wgsl_module", "blocks", || {
        let (open, close) = ("{".repeat(DEPTH), "}".repeat(DEPTH));
        format!("@compute @workgroup_size(1) fn main() {{ {open}{close} }}").into_bytes()
    }),
    storm("wgsl_module", "else if", || {
        let ifs = " else if true {}".repeat(DEPTH / 2);
        format!("@compute @workgroup_size(1) fn main() {{ if true {{}}{ifs} }}").into_bytes()
    }),
    storm("wgsl_module", "arrays of arrays", || {
        let (open, close) = ("array<".repeat(DEPTH), ", 2>".repeat(DEPTH));
        format!("var<private> x: {open}u32{close};").into_bytes()
    }),
    storm("wgsl_module", "aliases of aliases", || {
        let aliases = lines(20_000, |index| format!("alias a{} = array<a{index}, 1>;\n", index + 1));
        format!("alias a0 = u32;\n{aliases}var<private> x: a20000;").into_bytes()
    }),
    storm("wgsl_module", "an array of all memory", || {
        b"var<workgroup> x: array<array<u32, 2147483647>, 2147483647>;\n@compute @workgroup_size(1) fn main() { x[0][0] = 1u; }".to_vec()
    }),
    storm("wgsl_module", "a constant array of all memory", || {
        b"const x = array<u32, 4294967295>();\n@compute @workgroup_size(1) fn main() { var y = x[0]; }"
            .to_vec()
    }),
    storm("wgsl_module", "functions that call the next", || {
        let functions = lines(10_000, |index| format!("fn f{index}() {{ f{}(); }}\n", index + 1));
        format!("{functions}fn f10000() {{}}\n@compute @workgroup_size(1) fn main() {{ f0(); }}").into_bytes()
    }),
    storm("wgsl_module", "a comment in a comment", || "/*".repeat(DEPTH).into_bytes()),
    storm("wgsl_module", "sums within the bound", || module(&format!("1{}", " + 1".repeat(WITHIN)))),
    storm("wgsl_module", "elements within the bound", || module(&format!("a{}", "[0]".repeat(WITHIN)))),
    storm("wgsl_module", "calls of calls within the bound", || {
        let main = format!("{}1{}", "f(".repeat(WITHIN / 20), ")".repeat(WITHIN / 20));
        [&b"fn f(x: i32) -> i32 { return x; }"[..], &module(&main)].concat()
    }),
    storm("wgsl_module", "else if within the bound", || {
        let ifs = " else if true {}".repeat(WITHIN / 2);
        format!("@compute @workgroup_size(1) fn main() {{ if true {{}}{ifs} }}").into_bytes()
    }),
    storm("wgsl_module", "functions that call the next, within the bound", || {
        let functions = lines(WITHIN, |index| format!("fn f{index}() {{ f{}(); }}\n", index + 1));
        let main = "@compute @workgroup_size(1) fn main() { f0(); }";
        format!("{functions}fn f{WITHIN}() {{}}\n{main}").into_bytes()
    }),
    storm("wgsl_module", "constants of the next", || {
        let constants = lines(20_000, |index| format!("const c{index} = c{} + 1;\n", index + 1));
        format!("{constants}const c20000 = 1;").into_bytes()
    }),
    storm("wgsl_module", "less than less than", || module(&format!("a{}", "<a".repeat(DEPTH)))),
    storm("wgsl_module", "functions that call the one before twice", || {
        let functions = lines(30, |f| format!("fn f{}() -> u32 {{ return f{f}() + f{f}(); }}\n", f + 1));
        let main = "@compute @workgroup_size(1) fn main() { var x = f30(); }";
        format!("fn f0() -> u32 {{ return 1u; }}\n{functions}{main}").into_bytes()
    }),
    storm("wgsl_module", "2 MiB", || vec![b' '; 2 << 20]),
];
