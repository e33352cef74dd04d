//! Settings of the binary: config file, then environment, then flags, each overruling the one before.

use std::{
    fs,
    net::{SocketAddr, ToSocketAddrs as _},
    path::{Path, PathBuf},
    time::Duration,
};

use anyhow::{Context as _, bail, ensure};
use clap::{
    Parser,
    builder::{OsStringValueParser, TypedValueParser as _},
};
use farm_core::worker::Share;
use gpu_exec::DeviceSpec;
use proto::{
    control::coordinator_addresses,
    trust::{Identity, Role, default_identity},
};
use serde::Deserialize;
use worker::{Isolation, WorkerOptions};

/// Largest config file that is read, in bytes.
const MAX_CONFIG_BYTES: u64 = 1 << 20;
/// How long the coordinator is tried at the start.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(30);
/// Longest name of a node, in bytes.
const MAX_NAME_BYTES: usize = 128;
/// Most addresses of a node.
const MAX_ADVERTISED: usize = 16;

/// Gives this machine's devices to a farm.
///
/// When it is registered, it prints one JSON line on stdout with its node, data address and devices; logs go to stderr
/// (RUST_LOG). SIGTERM or SIGINT drains it, a second one ends it at once. Exit codes: 0 ended as asked, 1 failed, 2 wrong
/// usage or settings, 3 coordinator unreachable at the start, 4 not let in.
#[derive(Debug, Parser)]
#[command(name = "farm-worker", version)]
pub(crate) struct Arguments {
    /// Settings in TOML; the environment and flags overrule it.
    #[arg(long, value_name = "FILE", env = "GLEANER_CONFIG")]
    config: Option<PathBuf>,
    /// The farm's coordinator; where it has standbys these, too, with commas between.
    #[arg(long, value_name = "HOST:PORT", env = "GLEANER_COORDINATOR")]
    coordinator: Option<String>,
    /// Address for applications (UDP); port 0 lets the system choose [default: 127.0.0.1:0].
    #[arg(long, value_name = "HOST:PORT", env = "GLEANER_LISTEN")]
    listen: Option<String>,
    /// An address under which applications reach this node; repeat it for each (in the environment: commas)
    /// [default: the listening address].
    #[arg(long, value_name = "HOST:PORT", env = "GLEANER_ADVERTISE", value_delimiter = ',')]
    advertise: Vec<String>,
    /// The node's name; a second worker of one name takes the first one's place [default: host name and process id; in a secured
    /// farm the identity's, which may be followed by /ANYTHING].
    #[arg(long, value_name = "NAME", env = "GLEANER_NAME")]
    name: Option<String>,
    /// A device to give: all | gpu:N | cpu | sim:score=1000,speed=1.0; repeat it for each (in the environment: semicolons)
    /// [default: all].
    #[arg(long, value_name = "SPEC", env = "GLEANER_DEVICE", value_delimiter = ';')]
    device: Vec<String>,
    /// Who this node is in a secured farm: what `farmctl join` has written
    /// [default: ~/.config/gleaner/node.pem, if there is one].
    #[arg(long, value_name = "FILE", env = "GLEANER_IDENTITY", value_parser = OsStringValueParser::new().map(PathBuf::from))]
    identity: Option<PathBuf>,
    /// Folder for caches: task data that came from elsewhere is kept there over restarts, 32 GiB of it unless
    /// `disk_cache_bytes` in the config file says otherwise. A folder for each worker [default: none].
    #[arg(long, value_name = "DIR", env = "GLEANER_CACHE")]
    cache: Option<PathBuf>,
    /// How long the coordinator is tried at the start, as 500ms, 30s, 5m or 1h [default: 30s].
    #[arg(long, value_name = "DURATION", env = "GLEANER_CONNECT_TIMEOUT")]
    connect_timeout: Option<String>,
    /// Serve a farm that is not secured, whatever identity there is: refuses to listen on anything but loopback.
    #[arg(
        long,
        env = "GLEANER_INSECURE",
        num_args = 0..=1,
        default_missing_value = "true",
        require_equals = true,
        value_parser = clap::builder::BoolishValueParser::new()
    )]
    insecure: Option<bool>,
}

/// The config file.
#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
struct ConfigFile {
    coordinator: Option<String>,
    listen: Option<String>,
    #[serde(default)]
    advertise: Vec<String>,
    name: Option<String>,
    #[serde(default)]
    device: Vec<String>,
    identity: Option<PathBuf>,
    cache: Option<PathBuf>,
    connect_timeout: Option<String>,
    insecure: Option<bool>,
    /// How long one job may run.
    job_limit: Option<String>,
    /// Most bytes of task allocations and modules kept in memory.
    content_cache_bytes: Option<u64>,
    /// Most bytes of them kept in the cache folder.
    disk_cache_bytes: Option<u64>,
    /// Most bytes of results that an application may leave unacknowledged.
    spool_quota_bytes: Option<u64>,
    /// Bytes of results kept in memory, those of all applications together.
    spool_memory_bytes: Option<u64>,
    /// Most bytes of results kept in the cache folder, where memory has no room for them.
    spool_disk_bytes: Option<u64>,
    /// How devices are shared between applications.
    #[serde(default)]
    share: Rule,
    #[serde(default)]
    scheduler: SchedulerSection,
}

/// The `share` of the config file.
#[derive(Clone, Copy, Debug, Default, Deserialize)]
#[serde(rename_all = "lowercase")]
enum Rule {
    #[default]
    Lottery,
    Stride,
}

/// What only who measures the scheduler changes.
#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
struct SchedulerSection {
    /// Whether an idle device takes queued jobs of its siblings.
    #[serde(default)]
    local_stealing: Switch,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
enum Switch {
    #[default]
    On,
    Off,
}

/// Checked options from everything the user said. Every error is a usage error and names flag, file or key.
pub(crate) fn options(arguments: Arguments) -> anyhow::Result<WorkerOptions> {
    let file = arguments.config.as_deref().map(read_config).transpose()?.unwrap_or_default();
    let Some(coordinator) = arguments.coordinator.or(file.coordinator) else {
        bail!(
            "no coordinator: say --coordinator HOST:PORT, GLEANER_COORDINATOR, or `coordinator` in the config file"
        );
    };
    coordinator_addresses(&coordinator).context("coordinator")?;
    let defaults = WorkerOptions::embedded(coordinator, Vec::new());
    let listen = address(arguments.listen.or(file.listen), defaults.listen)?;
    let insecure = arguments.insecure.or(file.insecure).unwrap_or(false);
    if insecure {
        ensure!(
            listen.ip().is_loopback(),
            "--insecure allows loopback only, but listen is {listen}; listen on 127.0.0.1, or leave --insecure out on a \
             network you trust"
        );
    }
    let advertise = or_else(arguments.advertise, file.advertise);
    ensure!(advertise.len() <= MAX_ADVERTISED, "advertise: at most {MAX_ADVERTISED} addresses may be");
    advertise.iter().try_for_each(|address| check_host_port("advertise", address))?;
    ensure!(
        !(advertise.is_empty() && listen.ip().is_unspecified()),
        "listen {listen} is no address that others can dial: say --advertise HOST:PORT for each that they can"
    );
    let identity = if insecure { None } else { identity(arguments.identity.or(file.identity))? };
    Ok(WorkerOptions {
        listen,
        advertise,
        name: name(arguments.name.or(file.name), identity.as_ref())?,
        identity,
        devices: devices(or_else(arguments.device, file.device))?,
        connect_timeout: duration(
            "connect_timeout",
            arguments.connect_timeout.or(file.connect_timeout),
            CONNECT_TIMEOUT,
        )?,
        content_cache_bytes: file.content_cache_bytes.unwrap_or(defaults.content_cache_bytes),
        disk_cache_bytes: file.disk_cache_bytes.unwrap_or(defaults.disk_cache_bytes),
        spool_quota_bytes: file.spool_quota_bytes.unwrap_or(defaults.spool_quota_bytes),
        spool_memory_bytes: file.spool_memory_bytes.unwrap_or(defaults.spool_memory_bytes),
        spool_disk_bytes: file.spool_disk_bytes.unwrap_or(defaults.spool_disk_bytes),
        job_limit: duration("job_limit", file.job_limit, defaults.job_limit)?,
        local_stealing: file.scheduler.local_stealing == Switch::On,
        share: match file.share {
            Rule::Lottery => Share::DEFAULT,
            Rule::Stride => Share::Stride,
        },
        cache: arguments.cache.or(file.cache),
        isolation: Isolation::own_binary(),
        ..defaults
    })
}

/// The first list, or the second where the first is empty.
fn or_else(first: Vec<String>, second: Vec<String>) -> Vec<String> {
    if first.is_empty() { second } else { first }
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

fn address(given: Option<String>, default: SocketAddr) -> anyhow::Result<SocketAddr> {
    let Some(given) = given else { return Ok(default) };
    let mut found = given.to_socket_addrs().with_context(|| format!("listen {given:?} is not HOST:PORT"))?;
    found.next().with_context(|| format!("listen {given:?}: the name has no address"))
}

/// Names are resolved when they are dialled; here the form is checked only.
fn check_host_port(key: &str, address: &str) -> anyhow::Result<()> {
    let port = address.rsplit_once(':').filter(|(host, _)| !host.is_empty()).map(|(_, port)| port);
    let port = port.and_then(|port| port.parse::<u16>().ok());
    ensure!(port.is_some_and(|port| port > 0), "{key} {address:?} is not HOST:PORT");
    Ok(())
}

/// The identity in the file given, or in the usual one if it is there; a variable that was set to nothing gives none.
fn identity(given: Option<PathBuf>) -> anyhow::Result<Option<Identity>> {
    let given = given.filter(|path| !path.as_os_str().is_empty());
    let usual = || default_identity("node").filter(|path| path.exists());
    let Some(path) = given.or_else(usual) else { return Ok(None) };
    let identity = Identity::read(&path).context("identity")?;
    let role = identity.principal().role;
    ensure!(role == Role::Node, "identity {}: is of {}, not of a node", path.display(), identity.principal());
    Ok(Some(identity))
}

/// The name given; else the identity's, under which the node comes back as itself.
fn name(given: Option<String>, identity: Option<&Identity>) -> anyhow::Result<String> {
    let Some(name) = given.or_else(|| identity.map(|identity| identity.principal().name.clone())) else {
        let host = fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default();
        let host = match host.trim() {
            "" => "worker",
            host => host,
        };
        return Ok(format!("{host}-{}", std::process::id()));
    };
    let fits = !name.is_empty() && name.len() <= MAX_NAME_BYTES && !name.contains(char::is_control);
    ensure!(fits, "name {name:?}: a name has 1 to {MAX_NAME_BYTES} B and no control characters");
    Ok(name)
}

fn devices(given: Vec<String>) -> anyhow::Result<Vec<DeviceSpec>> {
    if given.is_empty() {
        return Ok(vec![DeviceSpec::All]);
    }
    // The error names the value and the key in it.
    given.iter().map(|spec| spec.parse().map_err(anyhow::Error::new)).collect()
}

fn duration(key: &str, given: Option<String>, default: Duration) -> anyhow::Result<Duration> {
    let Some(given) = given else { return Ok(default) };
    let split = given.find(|c: char| !c.is_ascii_digit()).unwrap_or(given.len());
    let (count, unit) = given.split_at(split);
    let unit_ms = match unit {
        "ms" => Some(1),
        "s" => Some(1_000),
        "m" => Some(60_000),
        "h" => Some(3_600_000),
        _ => None,
    };
    let ms = unit_ms.and_then(|unit_ms| count.parse::<u64>().ok()?.checked_mul(unit_ms));
    let Some(ms) = ms.filter(|ms| *ms > 0) else {
        bail!("{key} {given:?} is no duration like 500ms, 30s, 5m or 1h");
    };
    Ok(Duration::from_millis(ms))
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

    fn parse(flags: &[&str], config: Option<&str>) -> anyhow::Result<WorkerOptions> {
        let config = config.map(file);
        let mut arguments = Arguments::try_parse_from(["farm-worker"].iter().chain(flags)).unwrap();
        if let Some(config) = &config {
            arguments.config = Some(config.path().to_owned());
        }
        options(arguments)
    }

    const COORDINATOR: [&str; 2] = ["--coordinator", "host:7700"];

    #[test]
    fn defaults_are_loopback_and_every_device() {
        let options = parse(&COORDINATOR, None).unwrap();
        assert_eq!(options.coordinator, "host:7700");
        assert_eq!(options.listen.to_string(), "127.0.0.1:0");
        assert_eq!(options.devices, [DeviceSpec::All]);
        assert_eq!(options.connect_timeout, CONNECT_TIMEOUT);
        assert!(options.name.ends_with(&std::process::id().to_string()), "{}", options.name);
        assert!(options.advertise.is_empty() && options.cache.is_none());
    }

    #[test]
    fn flags_overrule_the_file() {
        let config = "coordinator = 'a:1'\nlisten = '127.0.0.1:5'\nadvertise = ['b:2']\nname = 'n'\n\
                      device = ['cpu', 'gpu:1']\ncache = '/c'\nconnect_timeout = '5m'\njob_limit = '250ms'\n\
                      content_cache_bytes = 77\ndisk_cache_bytes = 79\nspool_quota_bytes = 78\nspool_memory_bytes = 76\n\
                      spool_disk_bytes = 75\nshare = 'stride'\n";
        let from_file = parse(&[], Some(config)).unwrap();
        assert_eq!((from_file.coordinator.as_str(), from_file.name.as_str()), ("a:1", "n"));
        assert_eq!(from_file.listen.to_string(), "127.0.0.1:5");
        assert_eq!(from_file.advertise, ["b:2"]);
        assert_eq!(from_file.devices, [DeviceSpec::Cpu, DeviceSpec::Gpu(1)]);
        assert_eq!(from_file.cache, Some(PathBuf::from("/c")));
        assert_eq!(from_file.connect_timeout, Duration::from_secs(300));
        assert_eq!(from_file.job_limit, Duration::from_millis(250));
        assert_eq!((from_file.content_cache_bytes, from_file.spool_quota_bytes), (77, 78));
        assert_eq!((from_file.spool_memory_bytes, from_file.spool_disk_bytes), (76, 75));
        assert_eq!(from_file.disk_cache_bytes, 79);
        assert!(from_file.local_stealing, "on unless it is switched off");
        assert_eq!(from_file.share, Share::Stride);

        let sim = "sim:score=2,speed=3";
        let flags =
            ["--coordinator=x:9", "--device", sim, "--device", "cpu", "--advertise=y:1,z:2", "--name=m"];
        let overruled = parse(&flags, Some(config)).unwrap();
        assert_eq!((overruled.coordinator.as_str(), overruled.name.as_str()), ("x:9", "m"));
        assert_eq!(overruled.devices, [sim.parse().unwrap(), DeviceSpec::Cpu]);
        assert_eq!(overruled.advertise, ["y:1", "z:2"]);
        assert_eq!(overruled.listen.to_string(), "127.0.0.1:5", "what no flag says is the file's");
    }

    #[test]
    fn local_stealing_is_switched_off_by_the_file_alone() {
        let parsed =
            |value: &str| parse(&COORDINATOR, Some(&format!("[scheduler]\nlocal_stealing = {value}\n")));
        assert!(!parsed("'off'").unwrap().local_stealing);
        assert!(parsed("'on'").unwrap().local_stealing);
        let error = format!("{:#}", parsed("'maybe'").unwrap_err());
        assert!(error.contains("line 2") && error.contains("maybe"), "{error}");
    }

    #[test]
    fn errors_name_the_place() {
        let long_name = "n".repeat(MAX_NAME_BYTES + 1);
        let with = |flags: &[&'static str]| [COORDINATOR.as_slice(), flags].concat();
        let cases: [(Vec<&str>, Option<&str>, &[&str]); 15] = [
            (vec![], None, &["--coordinator", "GLEANER_COORDINATOR"]),
            (vec!["--coordinator", "host"], None, &["coordinator", "\"host\"", "HOST:PORT"]),
            (vec!["--coordinator", "host:0"], None, &["\"host:0\""]),
            (vec!["--coordinator", ":7700"], None, &["\":7700\""]),
            (
                vec![],
                Some("coordinator = 'a:1'\ncoordinater = 'a:1'\n"),
                &["config file", "line 2", "coordinater"],
            ),
            (vec![], Some("share = 'fair'\n"), &["config file", "line 1", "lottery", "stride"]),
            (vec![], Some("device = 'cpu'\n"), &["config file", "line 1"]),
            (with(&["--config", "/no/such/file.toml"]), None, &["/no/such/file.toml"]),
            (with(&["--listen", "7800"]), None, &["listen", "\"7800\""]),
            (with(&["--listen", "0.0.0.0:7800"]), None, &["0.0.0.0:7800", "--advertise"]),
            (
                with(&["--insecure", "--listen", "0.0.0.0:1", "--advertise", "a:1"]),
                None,
                &["--insecure", "0.0.0.0:1"],
            ),
            (with(&["--advertise", "nowhere"]), None, &["advertise", "nowhere"]),
            (with(&["--device", "sim:sped=2"]), None, &["sim:sped=2", "`sped`"]),
            (with(&["--connect-timeout", "30"]), None, &["connect_timeout", "\"30\""]),
            ([COORDINATOR.as_slice(), &["--name", &long_name]].concat(), None, &["name", "128 B"]),
        ];
        for (flags, config, parts) in cases {
            let error = format!("{:#}", parse(&flags, config).unwrap_err());
            for part in parts {
                assert!(error.contains(part), "{part:?} is missing in: {error}");
            }
        }
        let allowed = with(&["--listen", "0.0.0.0:7800", "--advertise", "a:7800"]);
        assert!(parse(&allowed, None).is_ok(), "an explicit address is being told so");
    }
}
