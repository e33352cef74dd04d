//! The command line as typed: raw arguments and their checks, no work.

use std::{fmt::Display, path::PathBuf, str::FromStr, time::Duration};

use clap::{
    Args, Parser, Subcommand, ValueEnum,
    builder::{OsStringValueParser, TypedValueParser},
};
use farm_core::coordinator::policy::{FCFS, NEIGHBOURS};
use mi_kernel::generate::RandomAlignment;
use proto::control::coordinator_addresses;

use crate::{failure::Failure, target::Target};

/// A path, or the empty text of an environment variable that was set to nothing.
fn path_or_nothing() -> impl TypedValueParser<Value = PathBuf> {
    OsStringValueParser::new().map(PathBuf::from)
}

/// Gleaner: a GPU compute farm whose idle devices glean work from busy ones.
#[derive(Debug, Parser)]
#[command(name = "farmctl", version, disable_version_flag = false)]
pub(crate) struct Cli {
    /// The farm's coordinator, and with commas between its standbys; without one, `render` and `mi` start a farm of their own, as `bench` always does.
    #[arg(long, env = "GLEANER_COORDINATOR", value_name = "HOST:PORT", global = true)]
    pub coordinator: Option<String>,
    /// Who you are in a secured farm: what `init` or `join` has written; there, where it is written to
    /// [default: ~/.config/gleaner/user.pem, of nodes node.pem].
    #[arg(long, env = "GLEANER_IDENTITY", value_name = "FILE", global = true, value_parser = path_or_nothing())]
    pub identity: Option<PathBuf>,
    /// Speak to a farm that is not secured, whatever identity there is.
    #[arg(
        long,
        env = "GLEANER_INSECURE",
        num_args = 0..=1,
        default_missing_value = "true",
        require_equals = true,
        global = true,
        value_parser = clap::builder::BoolishValueParser::new()
    )]
    pub insecure: Option<bool>,
    /// How reads are printed.
    #[arg(short = 'o', long, value_enum, default_value_t = Format::Table, id = "format")]
    pub output: Format,
    #[command(subcommand)]
    pub verb: Verb,
}

impl Cli {
    /// The farm asked for.
    pub(crate) fn target(&self) -> Result<Target<'_>, Failure> {
        let identity = self.identity.as_deref().filter(|path| !path.as_os_str().is_empty());
        Ok(Target::new(self.coordinator()?, identity, self.insecure.unwrap_or(false)))
    }

    /// The coordinator asked for; an empty variable is none.
    fn coordinator(&self) -> Result<Option<&str>, Failure> {
        let Some(address) = self.coordinator.as_deref().filter(|address| !address.is_empty()) else {
            return Ok(None);
        };
        match coordinator_addresses(address) {
            Ok(_) => Ok(Some(address)),
            Err(error) => {
                Err(Failure::Usage(anyhow::anyhow!("coordinator: {error}, such as 127.0.0.1:7700")))
            }
        }
    }
}

/// How a read is printed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Format {
    /// Columns for people.
    Table,
    /// More columns.
    Wide,
    /// One JSON document.
    Json,
    /// One JSON document a line.
    Ndjson,
}

#[derive(Debug, Subcommand)]
pub(crate) enum Verb {
    /// Run a whole farm in this process: coordinator and one worker over every device found.
    Up(UpArgs),
    /// Render a scene to an image.
    Render(RenderArgs),
    /// Mutual information of an alignment's columns, with the shuffling null model.
    Mi(MiArgs),
    /// Write one of the shipped scenes into a folder.
    Scene(SceneArgs),
    /// Write a random alignment, of the sizes of the thesis' sets or of any other.
    Alignment(AlignmentArgs),
    /// Show the farm: nodes, devices, queues, applications.
    Status(StatusArgs),
    /// Show what ran when and where: a table, a picture, or a trace for ui.perfetto.dev.
    Timeline(TimelineArgs),
    /// Look after nodes.
    #[command(subcommand)]
    Node(NodeVerb),
    /// Look after the caches of nodes.
    #[command(subcommand)]
    Cache(CacheVerb),
    /// Secure a farm: make its authority in a coordinator's state folder, and you its first operator.
    Init(InitArgs),
    /// Become a member of a secured farm, by a token of its operator.
    Join(JoinArgs),
    /// Look after join tokens.
    #[command(subcommand)]
    Token(TokenVerb),
    /// Look after members.
    #[command(subcommand)]
    Member(MemberVerb),
    /// Look after projects: whose applications may have how much of the farm.
    #[command(subcommand)]
    Project(ProjectVerb),
    /// Measure the farm against its bars.
    Bench(BenchArgs),
    /// Print versions.
    Version(VersionArgs),
}

#[derive(Debug, Args)]
pub(crate) struct UpArgs {
    /// Address of the coordinator; port 0 lets the system choose.
    #[arg(long, value_name = "HOST:PORT", default_value = "127.0.0.1:7700")]
    pub listen: String,
    /// Address of the status page and of /metrics.
    #[arg(long, value_name = "HOST:PORT", default_value = "127.0.0.1:7701")]
    pub http: String,
    /// Devices of the worker: all, gpu:N, cpu, sim:score=1000,speed=1.0; repeatable.
    #[arg(long = "device", value_name = "SPEC")]
    pub devices: Vec<String>,
}

#[derive(Debug, Args)]
pub(crate) struct RenderArgs {
    /// A scene folder or its scene.toml.
    pub scene: PathBuf,
    /// Where the image goes: .exr (layers, linear) or .png (8 bit sRGB); repeatable.
    #[arg(short = 'o', long = "output", value_name = "IMAGE", required = true, value_parser = image_path)]
    pub images: Vec<PathBuf>,
    /// Image size in pixels; the scene's own without it.
    #[arg(long, value_name = "WxH")]
    pub size: Option<Size>,
    /// Samples per pixel.
    #[arg(long, default_value_t = 64, value_parser = clap::value_parser!(u32).range(1..=1 << 24))]
    pub spp: u32,
    /// Same seed, same kind of device: same image, byte for byte.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Keep results in a journal beside the first image (IMAGE.gleaner-journal), and go on from it if it is there: after a crash
    /// or ^C the same command computes what is left. It is removed when the images are written.
    #[arg(long)]
    pub resume: bool,
    /// Brightness of the PNG in stops.
    #[arg(long, default_value_t = 0.0, allow_negative_numbers = true, value_parser = stops)]
    pub exposure: f32,
    /// How the coordinator spreads the jobs: fcfs, neighbours, history, or the name of a plug-in of its own.
    #[arg(long, value_name = "NAME", default_value = NEIGHBOURS)]
    pub policy: String,
    /// How progress is told.
    #[arg(long, value_enum, default_value_t = ProgressStyle::Auto)]
    pub progress: ProgressStyle,
    /// Devices of the own farm when no coordinator is given; repeatable.
    #[arg(long = "device", value_name = "SPEC")]
    pub devices: Vec<String>,
}

#[derive(Clone, Debug, Args)]
pub(crate) struct MiArgs {
    /// The alignment: FASTA, A3M, A2M, Stockholm, Clustal or one sequence a line; gzip too.
    pub alignment: PathBuf,
    /// Where the results go; made if missing.
    #[arg(short = 'o', long = "output", value_name = "FOLDER")]
    pub folder: PathBuf,
    /// Iterations of the null model: every column shuffled by itself.
    #[arg(long, default_value_t = 1_000, value_parser = clap::value_parser!(u64).range(1..=10_000_000))]
    pub iterations: u64,
    /// Same seed, same results, byte for byte, on any farm.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Go on from the sums in the folder, up to ITERATIONS in all: the same bytes as in one run.
    #[arg(long)]
    pub extend: bool,
    /// Keep results of jobs in a journal in the folder, and go on from it if it is there: after a crash or ^C the same command
    /// computes what is left. It is removed when the results are written; before that nothing else is.
    #[arg(long)]
    pub resume: bool,
    /// Leaves out sequences with residues in less than this share of the columns, 0 to 1.
    #[arg(long, value_name = "SHARE", value_parser = share)]
    pub min_coverage: Option<f64>,
    /// Leaves out sequences that share more than this part of their residues with an earlier one, 0 to 1.
    #[arg(long, value_name = "SHARE", value_parser = share)]
    pub max_identity: Option<f64>,
    /// Leaves out columns with gaps in more than this share of the sequences that are left, 0 to 1.
    #[arg(long, value_name = "SHARE", value_parser = share)]
    pub max_gap_share: Option<f64>,
    /// How gaps count: as a symbol (ormi), or apart: rows with a gap in either column left out of the pair (sumi), out of its
    /// joint entropy alone (demi), or out of its joint distribution alone (esmi).
    #[arg(long, value_enum, default_value_t = Gaps::Ormi)]
    pub gaps: Gaps,
    /// What the farm sends back.
    #[arg(long, value_enum, default_value_t = MiMode::Reduce)]
    pub mode: MiMode,
    /// How many pairs the table holds; five a column without it.
    #[arg(long, value_name = "PAIRS")]
    pub top: Option<usize>,
    /// How the coordinator spreads the jobs: fcfs, neighbours, history, or the name of a plug-in of its own.
    #[arg(long, value_name = "NAME", default_value = FCFS)]
    pub policy: String,
    /// How progress is told.
    #[arg(long, value_enum, default_value_t = ProgressStyle::Auto)]
    pub progress: ProgressStyle,
    /// Devices of the own farm when no coordinator is given; repeatable.
    #[arg(long = "device", value_name = "SPEC")]
    pub devices: Vec<String>,
}

/// How gaps count in mutual information (BioPhysConnectoR's names).
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Gaps {
    /// A gap is a symbol like all others.
    Ormi,
    /// Entropies over the rows with residues in both columns.
    Sumi,
    /// Entropies over each column's residues, the joint one over the rows with both.
    Demi,
    /// Joint distribution over the rows with residues in both, each column's own over its residues.
    Esmi,
}

/// What jobs of `mi` send back; the results are the same.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum MiMode {
    /// Sums over many iterations.
    Reduce,
    /// Every iteration's matrix.
    Matrix,
}

/// How progress is told.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum ProgressStyle {
    /// A bar on a terminal, nothing otherwise.
    Auto,
    /// A line of JSON on stdout at each step.
    Ndjson,
    /// Nothing.
    None,
}

#[derive(Debug, Args)]
pub(crate) struct SceneArgs {
    /// Which scene; `farmctl scene list` names them.
    pub name: String,
    /// The folder to write; made if missing.
    pub folder: Option<PathBuf>,
    /// Size of the generated geometry, where the scene has one (triangles, roughly).
    #[arg(long)]
    pub triangles: Option<u32>,
}

#[derive(Debug, Args)]
pub(crate) struct AlignmentArgs {
    /// Which sizes; `farmctl alignment list` names them.
    pub name: String,
    /// The FASTA file to write.
    pub file: Option<PathBuf>,
    /// Sequences, instead of the set's.
    #[arg(long)]
    pub sequences: Option<usize>,
    /// Columns, instead of the set's.
    #[arg(long)]
    pub columns: Option<usize>,
    /// Symbols, the gap among them; 21 without it.
    #[arg(long)]
    pub symbols: Option<usize>,
    /// Columns that hold one symbol in nine of ten places.
    #[arg(long)]
    pub conserved: bool,
    /// Same seed, same bytes.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
}

#[derive(Debug, Args)]
pub(crate) struct StatusArgs {
    /// How it is printed (as before the verb).
    #[arg(short = 'o', long, value_enum, id = "status_format")]
    pub output: Option<Format>,
    /// Print again every INTERVAL until interrupted.
    #[arg(long, value_name = "INTERVAL", num_args = 0..=1, default_missing_value = "1s", value_parser = pause)]
    pub watch: Option<Duration>,
}

#[derive(Debug, Args)]
pub(crate) struct TimelineArgs {
    /// An application or one of its tasks: app-3, 3, app-3/task-1, 3/1, @last or @all.
    #[arg(default_value = "@last")]
    pub task: String,
    /// How it is shown; json or table as before the verb without it.
    #[arg(short = 'o', long, value_enum, id = "timeline_format")]
    pub output: Option<TimelineFormat>,
    /// Where it goes; stdout without it.
    #[arg(long, value_name = "FILE")]
    pub out: Option<PathBuf>,
}

/// How a timeline is shown.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum TimelineFormat {
    /// A line for each device.
    Table,
    /// A picture, as the thesis draws it.
    Svg,
    /// Trace events, for ui.perfetto.dev.
    Perfetto,
    /// Every segment.
    Json,
}

impl From<Format> for TimelineFormat {
    fn from(format: Format) -> Self {
        match format {
            Format::Table | Format::Wide => Self::Table,
            Format::Json | Format::Ndjson => Self::Json,
        }
    }
}

#[derive(Debug, Subcommand)]
pub(crate) enum NodeVerb {
    /// Let a node finish what runs and leave; its queued jobs go elsewhere.
    Drain {
        /// The node's name or id.
        node: String,
    },
}

#[derive(Debug, Subcommand)]
pub(crate) enum CacheVerb {
    /// List what nodes keep of task allocations and modules, in memory and on disk.
    Ls {
        /// How to print it.
        #[arg(short, long, value_enum)]
        output: Option<Format>,
    },
    /// Have nodes drop contents that no job needs.
    Evict {
        /// The beginning of a content's digest, as `farmctl cache ls` shows it; repeat it for each.
        #[arg(value_name = "CONTENT", required_unless_present = "all", conflicts_with = "all")]
        contents: Vec<String>,
        /// Everything that no job needs.
        #[arg(long)]
        all: bool,
        /// Only of this node: its name or id.
        #[arg(long, value_name = "NODE")]
        node: Option<String>,
    },
}

#[derive(Debug, Args)]
pub(crate) struct InitArgs {
    /// The state folder, as in `farm-coordinator --state DIR`.
    pub state: PathBuf,
    /// The farm's name.
    #[arg(long, value_name = "NAME", default_value = "farm")]
    pub farm: String,
    /// Your name as its operator.
    #[arg(long, value_name = "NAME", default_value = "operator")]
    pub operator: String,
}

#[derive(Debug, Args)]
pub(crate) struct JoinArgs {
    /// The token; `-` reads it from standard input, which keeps it out of the list of processes.
    pub token: String,
    /// Your name in the farm, where the token has none: of a node its name, else yours [default: this host's].
    #[arg(long, value_name = "NAME")]
    pub name: Option<String>,
}

#[derive(Debug, Subcommand)]
pub(crate) enum TokenVerb {
    /// Make a token.
    Create {
        /// What who joins becomes: a node gives devices, an app brings jobs, an operator does that and drains nodes and makes tokens.
        #[arg(value_enum)]
        role: MemberRole,
        /// The name that who joins gets; who has it now loses it. Without: any that nobody has.
        #[arg(long, value_name = "NAME")]
        name: Option<String>,
        /// How long the token can be used.
        #[arg(long, value_name = "DURATION", default_value = "1h", value_parser = duration)]
        expires: Duration,
        /// How often it can be used.
        #[arg(long, default_value_t = 1)]
        uses: u32,
        /// The project of who joins, of apps and operators [default: the project `default`].
        #[arg(long, value_name = "NAME")]
        project: Option<String>,
    },
    /// List the tokens that can still be used.
    Ls {
        /// How to print it.
        #[arg(short, long, value_enum)]
        output: Option<Format>,
    },
    /// Take a token back.
    Revoke {
        /// Its number.
        id: u64,
    },
}

/// What a token makes of who joins.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum MemberRole {
    /// Gives devices.
    Node,
    /// Brings jobs.
    App,
    /// Brings jobs, drains nodes, makes tokens.
    Operator,
}

#[derive(Debug, Subcommand)]
pub(crate) enum MemberVerb {
    /// List the farm's members.
    Ls {
        /// How to print it.
        #[arg(short, long, value_enum)]
        output: Option<Format>,
    },
    /// End a membership: its sessions end, and what its applications have on the farm goes half a minute later.
    Expel {
        /// Whose: gleaner://FARM/ROLE/NAME, as `ls` says.
        member: String,
    },
}

#[derive(Debug, Subcommand)]
pub(crate) enum ProjectVerb {
    /// List projects: what each has, and what it may have.
    Ls {
        /// How to print it.
        #[arg(short, long, value_enum)]
        output: Option<Format>,
    },
    /// Make a project, or change what its applications may have together; what you do not name stays.
    Set {
        /// Its name; `default` is the project of those who were put into no other.
        project: String,
        /// Devices that its jobs are on at a time; `none` lifts the bound.
        #[arg(long, value_name = "N|none", value_parser = bound::<u32>)]
        devices: Option<Bound<u32>>,
        /// Jobs that are planned at a time and not delivered; the others wait. `none` lifts the bound.
        #[arg(long, value_name = "N|none", value_parser = bound::<u64>)]
        queued_jobs: Option<Bound<u64>>,
        /// Task data and modules of its planned jobs, and on each node results that it has not fetched, such as 500MB or 8GiB;
        /// `none` lifts the bound.
        #[arg(long, value_name = "SIZE|none", value_parser = bound_of_size)]
        bytes: Option<Bound<u64>>,
        /// What the fair-share weights of its applications come to at most; `none` lifts the bound.
        #[arg(long, value_name = "WEIGHT|none", value_parser = bound::<f64>)]
        weight: Option<Bound<f64>>,
    },
    /// Remove a project that nobody belongs to and no token is for.
    Rm {
        /// Its name.
        project: String,
    },
}

/// A bound, or `none`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Bound<T>(pub Option<T>);

#[derive(Debug, Args)]
pub(crate) struct BenchArgs {
    /// Which figures.
    #[arg(value_enum)]
    pub name: BenchName,
    /// Of everything random in a bench: tile times, wrong scores, the order of jobs.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Runs of each measurement, of which the median counts; each bench has its own default.
    #[arg(long, value_parser = clap::value_parser!(u8).range(1..=25))]
    pub runs: Option<u8>,
    /// The alignment of `mi`; `farmctl alignment list` names them.
    #[arg(long, value_name = "NAME", default_value = "thesis-a")]
    pub set: RandomAlignment,
    /// Devices on which `mi` measures runtime and speed-up; repeatable.
    #[arg(long = "device", value_name = "SPEC")]
    pub devices: Vec<String>,
    /// Most iterations of `mi` on them.
    #[arg(long, default_value_t = 512, value_parser = clap::value_parser!(u64).range(8..=100_000))]
    pub iterations: u64,
    /// Points of its curve over iterations: all of them, then half, a quarter and an eighth.
    #[arg(long, default_value_t = 4, value_parser = clap::value_parser!(u8).range(1..=4))]
    pub points: u8,
    /// Where `steal` leaves pictures of its last runs (SVG): figures 5.11 and 5.12 of the thesis.
    #[arg(long, value_name = "FOLDER")]
    pub pictures: Option<PathBuf>,
    /// How they are printed (as before the verb).
    #[arg(short = 'o', long, value_enum, id = "bench_format")]
    pub output: Option<Format>,
}

#[derive(Debug, Args)]
pub(crate) struct VersionArgs {
    /// How they are printed (as before the verb).
    #[arg(short = 'o', long, value_enum, id = "version_format")]
    pub output: Option<Format>,
}

/// A set of figures with their bars (10-scheduling.md section 5).
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum BenchName {
    /// Round trip of a no-op job, jobs a second, CPU time a job.
    Scheduler,
    /// What stealing gains on irregular jobs, on equal and unequal devices; how soon an idle device is busy again.
    Steal,
    /// Shares of three applications of unequal weights and jobs; how soon a fourth one gets its first result.
    Fairness,
    /// Speed-up on equal jobs, by devices and by nodes.
    Scaling,
    /// A coordinator killed with 100,000 jobs outstanding: how soon work is done again, how much is done twice.
    Recovery,
    /// Mutual information: runtime over iterations and speed-up on given devices, overhead by simulated nodes.
    Mi,
}

/// An image size in pixels, both extents positive.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Size {
    pub width_px: u32,
    pub height_px: u32,
}

/// Largest extent of an image; the film of a square of it takes 16 GiB.
const MAX_EXTENT_PX: u32 = 16_384;

impl FromStr for Size {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let extents = text.split_once(['x', 'X']).and_then(|(width, height)| {
            Some(Self { width_px: width.parse().ok()?, height_px: height.parse().ok()? })
        });
        match extents {
            None => Err(format!("{text:?} is not WIDTHxHEIGHT, such as 640x360")),
            Some(size)
                if [size.width_px, size.height_px]
                    .iter()
                    .any(|&extent| extent == 0 || extent > MAX_EXTENT_PX) =>
            {
                Err(format!("{text}: width and height must be 1 to {MAX_EXTENT_PX} pixels"))
            }
            Some(size) => Ok(size),
        }
    }
}

fn image_path(text: &str) -> Result<PathBuf, String> {
    let path = PathBuf::from(text);
    let extension = path.extension().and_then(|extension| extension.to_str()).map(str::to_ascii_lowercase);
    match extension.as_deref() {
        Some("exr" | "png") => Ok(path),
        _ => Err(format!("{text:?}: the image's name must end in .exr or .png")),
    }
}

/// Stops within which any picture is neither black nor white: an f32 has 254.
const MAX_EXPOSURE: f32 = 64.0;

fn stops(text: &str) -> Result<f32, String> {
    match text.parse::<f32>() {
        Ok(exposure) if exposure.abs() <= MAX_EXPOSURE => Ok(exposure),
        _ => Err(format!(
            "{text:?}: the exposure must be a number of stops in -{MAX_EXPOSURE}..={MAX_EXPOSURE}"
        )),
    }
}

fn duration(text: &str) -> Result<Duration, String> {
    let split = text.find(|c: char| !c.is_ascii_digit() && c != '.').unwrap_or(text.len());
    let (number, unit) = text.split_at(split);
    let seconds = match unit {
        "ms" => 0.001,
        "s" | "" => 1.0,
        "m" => 60.0,
        "h" => 3_600.0,
        _ => return Err(format!("{text:?}: the unit must be ms, s, m or h")),
    };
    let number: f64 =
        number.parse().map_err(|_| format!("{text:?} is not a duration, such as 500ms or 15m"))?;
    Duration::try_from_secs_f64(number * seconds).map_err(|error| format!("{text:?}: {error}"))
}

fn bound<T: FromStr<Err: Display>>(text: &str) -> Result<Bound<T>, String> {
    match text {
        "none" => Ok(Bound(None)),
        text => text.parse().map(|most| Bound(Some(most))).map_err(|error| format!("{error}, and not none")),
    }
}

fn bound_of_size(text: &str) -> Result<Bound<u64>, String> {
    if text == "none" { Ok(Bound(None)) } else { size(text).map(|bytes| Bound(Some(bytes))) }
}

/// Bytes, such as `500MB` or `8GiB`.
fn size(text: &str) -> Result<u64, String> {
    let split = text.find(|c: char| !c.is_ascii_digit()).unwrap_or(text.len());
    let (number, unit) = text.split_at(split);
    let unit: u64 = match unit {
        "" | "B" => 1,
        "kB" => 1_000,
        "MB" => 1_000_000,
        "GB" => 1_000_000_000,
        "TB" => 1_000_000_000_000,
        "KiB" => 1 << 10,
        "MiB" => 1 << 20,
        "GiB" => 1 << 30,
        "TiB" => 1 << 40,
        _ => return Err(format!("{text:?}: the unit must be B, kB, MB, GB, TB, KiB, MiB, GiB or TiB")),
    };
    let number: u64 = number.parse().map_err(|_| format!("{text:?} is not a size, such as 500MB or 8GiB"))?;
    number.checked_mul(unit).ok_or_else(|| format!("{text:?} is more than can be counted"))
}

/// A number from 0 to 1.
fn share(text: &str) -> Result<f64, String> {
    let share: f64 = text.parse().map_err(|error| format!("{error}"))?;
    if (0.0..=1.0).contains(&share) { Ok(share) } else { Err("not from 0 to 1".to_owned()) }
}

/// A pause between two looks at the farm: short ones would be nothing but load.
fn pause(text: &str) -> Result<Duration, String> {
    const LEAST: Duration = Duration::from_millis(100);
    let pause = duration(text)?;
    if pause < LEAST { Err(format!("{text:?}: at least {LEAST:?}")) } else { Ok(pause) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_checked() {
        assert_eq!("640x360".parse(), Ok(Size { width_px: 640, height_px: 360 }));
        for bad in ["", "640", "0x10", "10x0", "-1x4", "1e3x4", "99999x1"] {
            assert!(bad.parse::<Size>().is_err(), "{bad}");
        }
    }

    #[test]
    fn shares_are_from_0_to_1() {
        assert_eq!(share("0.25"), Ok(0.25));
        for bad in ["", "x", "-0.1", "1.5", "nan", "inf"] {
            assert!(share(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn a_farm_is_not_asked_without_a_pause() {
        assert_eq!(pause("100ms"), Ok(Duration::from_millis(100)));
        assert!(pause("0").unwrap_err().contains("at least 100ms"));
    }

    #[test]
    fn durations_have_units() {
        assert_eq!(duration("15m"), Ok(Duration::from_secs(900)));
        assert_eq!(duration("500ms"), Ok(Duration::from_millis(500)));
        for bad in ["", "x", "5d", "-1s", "1..2s"] {
            assert!(duration(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn sizes_have_units_and_bounds_may_be_none() {
        assert_eq!(size("7"), Ok(7));
        assert_eq!(size("500MB"), Ok(500_000_000));
        assert_eq!(size("8GiB"), Ok(8 << 30));
        for bad in ["", "x", "GiB", "-1", "1.5GiB", "5gb", "99999999999TiB"] {
            assert!(size(bad).is_err(), "{bad}");
        }
        assert_eq!(bound::<u32>("none"), Ok(Bound(None)));
        assert_eq!(bound::<u32>("3"), Ok(Bound(Some(3))));
        assert!(bound::<u32>("-3").is_err() && bound::<u32>("all").is_err());
    }

    #[test]
    fn output_means_format_before_the_verb_and_image_after_render() {
        let cli = Cli::try_parse_from(["farmctl", "-o", "json", "render", "s", "-o", "a.png", "-o", "b.exr"])
            .unwrap();
        assert_eq!(cli.output, Format::Json);
        let Verb::Render(render) = cli.verb else { panic!("render was parsed as {:?}", cli.verb) };
        assert_eq!(render.images, [PathBuf::from("a.png"), PathBuf::from("b.exr")]);
    }
}
