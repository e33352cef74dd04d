//! Settings of the binary: config file, then environment, then flags, each overruling the one before.

use std::{
    env, fs,
    net::{SocketAddr, ToSocketAddrs as _},
    path::{Path, PathBuf},
};

use anyhow::{Context as _, bail, ensure};
use clap::{Parser, Subcommand, ValueEnum};
use coordinator::{AUTHORITY_FILE, CoordinatorOptions, plugins::PluginOptions};
use farm_core::message::Liveness;
use serde::Deserialize;

/// Largest config file that is read, in bytes.
const MAX_CONFIG_BYTES: u64 = 1 << 20;

/// The folder of plug-in policies; overrules the config file's `plugins`.
const PLUGINS_VARIABLE: &str = "GLEANER_PLUGINS";

/// Registers applications and worker nodes, and plans their jobs.
///
/// When it can serve, it prints one JSON line on stdout with its addresses; logs go to stderr (RUST_LOG). SIGTERM or SIGINT
/// ends it, a second one at once. Exit codes: 0 ended as asked, 1 failed, 2 wrong usage or settings.
#[derive(Debug, Parser)]
#[command(name = "farm-coordinator", version)]
pub(crate) struct Arguments {
    /// Settings in TOML; the environment and flags overrule it.
    #[arg(long, value_name = "FILE", env = "GLEANER_CONFIG")]
    config: Option<PathBuf>,
    /// Address for applications and nodes; port 0 lets the system choose [default: 127.0.0.1:7700].
    #[arg(long, value_name = "HOST:PORT", env = "GLEANER_LISTEN")]
    listen: Option<String>,
    /// Address of status page, metrics and health; port 0 lets the system choose [default: 127.0.0.1:7701].
    #[arg(long, value_name = "HOST:PORT", env = "GLEANER_HTTP")]
    http: Option<String>,
    /// Directory for what must outlive this process; without it a restart is known by its time alone. One that `farmctl init`
    /// has secured lets members of the farm alone in.
    #[arg(long, value_name = "DIR", env = "GLEANER_STATE")]
    state: Option<PathBuf>,
    /// Wait, without listening anywhere, while another coordinator leads by this state directory, and take over when it is gone
    /// or silent (docs/standby.md).
    #[arg(
        long,
        env = "GLEANER_STANDBY",
        num_args = 0..=1,
        default_missing_value = "true",
        require_equals = true,
        value_parser = clap::builder::BoolishValueParser::new()
    )]
    standby: Option<bool>,
    /// How soon silence counts [default: default].
    #[arg(long, value_enum, env = "GLEANER_LIVENESS")]
    liveness: Option<Profile>,
    /// Let everyone in, in plain text, whatever the state directory says: refuses to listen on anything but loopback.
    #[arg(
        long,
        env = "GLEANER_INSECURE",
        num_args = 0..=1,
        default_missing_value = "true",
        require_equals = true,
        value_parser = clap::builder::BoolishValueParser::new()
    )]
    insecure: Option<bool>,
    #[command(subcommand)]
    pub(crate) role: Option<Role>,
}

/// What the executable is besides the coordinator.
#[derive(Debug, Subcommand)]
pub(crate) enum Role {
    /// The process that a plug-in runs in; started by the coordinator.
    #[command(hide = true)]
    PolicyHost {
        /// The shared object.
        object: PathBuf,
    },
}

/// Ready-made timings.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum, Deserialize)]
#[serde(rename_all = "lowercase")]
enum Profile {
    /// Heartbeat 1 s, suspect after 3 s, dead after 10 s.
    #[default]
    Default,
    /// For a small local network: heartbeat 200 ms, suspect after 600 ms, dead after 2 s.
    Lan,
}

impl Profile {
    fn liveness(self) -> Liveness {
        match self {
            Self::Default => Liveness::default(),
            Self::Lan => Liveness {
                heartbeat_ms: 200,
                suspect_ms: 600,
                dead_ms: 2_000,
                reconnect_ms: 1_000,
                ..Liveness::default()
            },
        }
    }
}

/// The config file.
#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
struct ConfigFile {
    listen: Option<String>,
    http: Option<String>,
    state: Option<PathBuf>,
    insecure: Option<bool>,
    standby: Option<bool>,
    /// How long a vanished application keeps its jobs, in milliseconds.
    app_lease_ms: Option<u64>,
    /// The folder of plug-in policies.
    plugins: Option<PathBuf>,
    #[serde(default)]
    liveness: LivenessTable,
}

/// A profile, and single values that differ from it, in milliseconds.
#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
struct LivenessTable {
    profile: Option<Profile>,
    heartbeat_ms: Option<u64>,
    suspect_ms: Option<u64>,
    dead_ms: Option<u64>,
    reconnect_ms: Option<u64>,
    compare_ms: Option<u64>,
}

/// What the user wants.
#[derive(Debug)]
pub(crate) struct Settings {
    pub(crate) options: CoordinatorOptions,
    /// Whether to wait for the lead.
    pub(crate) standby: bool,
}

/// Checked settings from everything the user said. Every error is a usage error and names flag, file or key.
pub(crate) fn settings(arguments: Arguments) -> anyhow::Result<Settings> {
    let file = arguments.config.as_deref().map(read_config).transpose()?.unwrap_or_default();
    let defaults = CoordinatorOptions::default();
    let listen = address("listen", arguments.listen.or(file.listen), defaults.listen)?;
    let http = address("http", arguments.http.or(file.http), defaults.http)?;
    let state = arguments.state.or(file.state);
    let insecure = arguments.insecure.or(file.insecure).unwrap_or(false);
    if insecure {
        for (name, address) in [("listen", listen), ("http", http)] {
            ensure!(
                address.ip().is_loopback(),
                "--insecure allows loopback only, but {name} is {address}; listen on 127.0.0.1, or leave --insecure out \
                 on a network you trust"
            );
        }
    }
    let standby = arguments.standby.or(file.standby).unwrap_or(false);
    ensure!(!standby || state.is_some(), "--standby needs --state, the directory that coordinators share");
    let plugins = env::var_os(PLUGINS_VARIABLE).map(PathBuf::from).or(file.plugins);
    let options = CoordinatorOptions {
        listen,
        http,
        secured: !insecure && state.as_deref().is_some_and(is_secured),
        insecure,
        state,
        vacancy: None,
        liveness: liveness(arguments.liveness, &file.liveness)?,
        app_lease_ms: file.app_lease_ms.unwrap_or(defaults.app_lease_ms),
        plugins: plugins.map(hosted_here).transpose()?,
    };
    Ok(Settings { options, standby })
}

/// Whether a farm's authority is there. One that cannot be read is an error later, not a farm without members.
pub(crate) fn is_secured(state: &Path) -> bool {
    state.join(AUTHORITY_FILE).symlink_metadata().is_ok()
}

/// Plug-ins run in further processes of this executable.
fn hosted_here(folder: PathBuf) -> anyhow::Result<PluginOptions> {
    let host = env::current_exe().context("plugins: the system does not say where this executable is")?;
    Ok(PluginOptions::new(folder, host))
}

fn read_config(path: &Path) -> anyhow::Result<ConfigFile> {
    let shown = path.display();
    let metadata = fs::metadata(path).with_context(|| format!("config file {shown}"))?;
    ensure!(metadata.is_file(), "config file {shown}: is not a file");
    ensure!(metadata.len() <= MAX_CONFIG_BYTES, "config file {shown}: is over {MAX_CONFIG_BYTES} B");
    let text = fs::read_to_string(path).with_context(|| format!("config file {shown}"))?;
    // toml's message names line, column and key.
    toml::from_str(&text).map_err(|error| anyhow::anyhow!("config file {shown}: {error}"))
}

fn address(name: &str, given: Option<String>, default: SocketAddr) -> anyhow::Result<SocketAddr> {
    let Some(given) = given else { return Ok(default) };
    let mut found = given.to_socket_addrs().with_context(|| format!("{name} {given:?} is not HOST:PORT"))?;
    found.next().with_context(|| format!("{name} {given:?}: the name has no address"))
}

fn liveness(flag: Option<Profile>, table: &LivenessTable) -> anyhow::Result<Liveness> {
    // A flag overrules the whole table.
    let Some(profile) = flag else {
        let base = table.profile.unwrap_or_default().liveness();
        let liveness = Liveness {
            heartbeat_ms: table.heartbeat_ms.unwrap_or(base.heartbeat_ms),
            suspect_ms: table.suspect_ms.unwrap_or(base.suspect_ms),
            dead_ms: table.dead_ms.unwrap_or(base.dead_ms),
            reconnect_ms: table.reconnect_ms.unwrap_or(base.reconnect_ms),
            compare_ms: table.compare_ms.unwrap_or(base.compare_ms),
        };
        let Liveness { heartbeat_ms, suspect_ms, dead_ms, .. } = liveness;
        if heartbeat_ms == 0 || heartbeat_ms >= suspect_ms || suspect_ms >= dead_ms {
            bail!(
                "liveness: 0 < heartbeat_ms < suspect_ms < dead_ms must hold, not {heartbeat_ms}, {suspect_ms}, {dead_ms}"
            );
        }
        return Ok(liveness);
    };
    Ok(profile.liveness())
}

#[cfg(test)]
mod tests {
    use std::io::Write as _;

    use super::*;

    fn file(text: &str) -> tempfile::NamedTempFile {
        let mut file = tempfile::NamedTempFile::new().unwrap();
        file.write_all(text.as_bytes()).unwrap();
        file
    }

    fn parse(flags: &[&str], config: Option<&str>) -> anyhow::Result<CoordinatorOptions> {
        let config = config.map(file);
        let mut arguments = Arguments::try_parse_from(["farm-coordinator"].iter().chain(flags)).unwrap();
        if let Some(config) = &config {
            arguments.config = Some(config.path().to_owned());
        }
        settings(arguments).map(|settings| settings.options)
    }

    #[test]
    fn defaults_are_loopback() {
        let options = parse(&[], None).unwrap();
        assert_eq!(options.listen.to_string(), "127.0.0.1:7700");
        assert_eq!(options.http.to_string(), "127.0.0.1:7701");
        assert_eq!(options.state, None);
        assert_eq!(options.liveness, Liveness::default());
    }

    #[test]
    fn flags_overrule_the_file() {
        let config = "listen = '127.0.0.1:1'\nhttp = '127.0.0.1:2'\nstate = '/a'\napp_lease_ms = 7\n\
                      [liveness]\nprofile = 'lan'\ndead_ms = 900\n";
        let from_file = parse(&[], Some(config)).unwrap();
        assert_eq!(from_file.listen.to_string(), "127.0.0.1:1");
        assert_eq!(from_file.state, Some(PathBuf::from("/a")));
        assert_eq!(from_file.app_lease_ms, 7);
        assert_eq!((from_file.liveness.heartbeat_ms, from_file.liveness.dead_ms), (200, 900));
        let flags = ["--listen", "127.0.0.1:3", "--state", "/b", "--liveness", "default"];
        let overruled = parse(&flags, Some(config)).unwrap();
        assert_eq!(overruled.listen.to_string(), "127.0.0.1:3");
        assert_eq!(overruled.http.to_string(), "127.0.0.1:2");
        assert_eq!(overruled.state, Some(PathBuf::from("/b")));
        assert_eq!(overruled.liveness, Liveness::default());
    }

    #[test]
    fn a_secured_state_directory_is_enough_and_insecure_overrules_it() {
        let state = tempfile::tempdir().unwrap();
        let path = state.path().to_str().unwrap();
        assert!(!parse(&["--state", path], None).unwrap().secured, "nobody has secured it");
        fs::write(state.path().join(AUTHORITY_FILE), "").unwrap();
        assert!(parse(&["--state", path], None).unwrap().secured);
        assert!(!parse(&["--state", path, "--insecure"], None).unwrap().secured);
    }

    #[test]
    fn errors_name_the_place() {
        let cases: [(&[&str], Option<&str>, &[&str]); 10] = [
            (&["--standby"], None, &["--standby", "--state"]),
            (&[], Some("http = '127.0.0.1:0'\nlisen = 'x'\n"), &["config file", "line 2", "lisen"]),
            (&[], Some("[liveness]\nprofile = 'fast'\n"), &["config file", "line 2", "fast"]),
            (&[], Some("listen = 5\n"), &["config file", "line 1", "string"]),
            (&[], Some("listen = \n"), &["config file", "line 1"]),
            (&[], Some("[liveness]\nheartbeat_ms = 5000\n"), &["heartbeat_ms", "5000"]),
            (&["--listen", "7700"], None, &["listen", "\"7700\"", "HOST:PORT"]),
            (&["--config", "/no/such/file.toml"], None, &["/no/such/file.toml"]),
            (&["--insecure", "--listen", "0.0.0.0:0"], None, &["--insecure", "listen", "0.0.0.0:0"]),
            (&["--insecure=true", "--http", "0.0.0.0:0"], None, &["--insecure", "http"]),
        ];
        for (flags, config, parts) in cases {
            let error = format!("{:#}", parse(flags, config).unwrap_err());
            for part in parts {
                assert!(error.contains(part), "{part:?} is missing in: {error}");
            }
        }
        assert!(parse(&["--insecure"], None).is_ok(), "loopback may be insecure");
        assert!(parse(&["--listen", "0.0.0.0:0"], None).is_ok(), "an explicit address is being told so");
    }
}
