//! `farmctl init`, `join`, `token ...` and `member ...`: who belongs to a secured farm.

use std::{
    fs,
    io::{self, Write as _},
    path::Path,
    time::Duration,
};

use anyhow::{Context as _, anyhow};
use farm_core::project::DEFAULT_PROJECT;
use proto::{
    control::{
        self, Invitation,
        v1::{MemberStatus, TokenStatus},
    },
    trust::{Identity, JoinToken, Role, check_name, unix_now},
};
use serde_json::{Value, json};

use crate::{
    admin::{self, Admin},
    cli::{Format, InitArgs, JoinArgs, MemberRole, MemberVerb, TokenVerb},
    failure::Failure,
    output::{self, printable},
    target::Target,
};

/// As many bytes an identity has at most.
const IDENTITY_BYTES: usize = 4_096;
/// Longest token that is read, in bytes.
const MAX_TOKEN_BYTES: u64 = 4_096;

/// Makes a farm's authority and its first operator.
pub(crate) fn init(arguments: &InitArgs, target: &Target<'_>) -> Result<(), Failure> {
    let file = target.identity_file("user")?;
    let (farm, operator) = (&arguments.farm, &arguments.operator);
    for (what, name) in [("--farm", farm), ("--operator", operator)] {
        check_name(what, name).map_err(|error| Failure::Usage(error.into()))?;
    }
    // A place before an authority: one without an operator would be of no use.
    check_writable(&file)?;
    let identity = coordinator::initialise(&arguments.state, farm, operator)?;
    keep(&identity, &file)?;
    output::print_text(&format!(
        "{farm} is secured: its authority is {}, and you are {} ({}).\n\
         Start it:            farm-coordinator --state {} --listen HOST:PORT\n\
         Let a machine join:  farmctl --coordinator HOST:PORT token create node\n\
         Let somebody use it: farmctl --coordinator HOST:PORT token create app\n",
        arguments.state.join(coordinator::AUTHORITY_FILE).display(),
        identity.principal(),
        file.display(),
        arguments.state.display(),
    ))
}

/// Becomes a member and keeps the identity.
pub(crate) async fn join(arguments: &JoinArgs, target: &Target<'_>) -> Result<(), Failure> {
    let usage = |error: anyhow::Error| Failure::Usage(error);
    let text = match arguments.token.as_str() {
        "-" => read_token().context("no token comes from standard input").map_err(usage)?,
        text => text.to_owned(),
    };
    let token: JoinToken = text.parse().map_err(|error| usage(anyhow::Error::new(error)))?;
    if let Some(name) = &arguments.name {
        check_name("--name", name).map_err(|error| usage(error.into()))?;
    }
    // A place before a member: a token is used once.
    for kind in ["user", "node"] {
        let file = target.identity_file(kind)?;
        check_writable(&file)?;
    }
    let identity = join_as(target.address(), &token, arguments.name.as_deref()).await?;
    let kind = if identity.principal().role == Role::Node { "node" } else { "user" };
    let file = target.identity_file(kind)?;
    keep(&identity, &file)?;
    let next = match identity.principal().role {
        Role::Node => format!("farm-worker --coordinator {}", target.address()),
        _ => format!("farmctl --coordinator {} status", target.address()),
    };
    output::print_text(&format!("You are {} ({}).\nNext: {next}\n", identity.principal(), file.display()))
}

/// A token without a name, and nobody who chose one, makes this host's.
async fn join_as(address: &str, token: &JoinToken, name: Option<&str>) -> Result<Identity, Failure> {
    let joined = control::join(address, token, name).await;
    match (joined, name) {
        (Err(control::SessionError::Denied { reason }), None) if reason.contains("choose one") => {
            let host = host_name()
                .ok_or_else(|| Failure::Usage(anyhow!("this host has no usable name: say --name")))?;
            control::join(address, token, Some(&host)).await.map_err(admin::failure)
        }
        (joined, _) => joined.map_err(admin::failure),
    }
}

fn host_name() -> Option<String> {
    let name = fs::read_to_string("/proc/sys/kernel/hostname").ok()?.trim().to_owned();
    check_name("host", &name).is_ok().then_some(name)
}

fn read_token() -> io::Result<String> {
    use std::io::Read as _;

    let mut text = String::new();
    io::stdin().lock().take(MAX_TOKEN_BYTES).read_to_string(&mut text)?;
    Ok(text)
}

/// Whether an identity could be written there.
fn check_writable(file: &Path) -> Result<(), Failure> {
    let folder =
        file.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or_else(|| Path::new("."));
    if file.is_dir() {
        return Err(Failure::Usage(anyhow!("{} is a folder, not a file for an identity", file.display())));
    }
    // As much as an identity, for a full disk is found out by writing.
    let probe = folder.join(format!(".gleaner-probe-{}", std::process::id()));
    let probed = fs::create_dir_all(folder).and_then(|()| {
        let mut written = fs::File::create(&probe)?;
        written.write_all(&[b' '; IDENTITY_BYTES])?;
        written.sync_all()
    });
    let removed = fs::remove_file(&probe);
    probed.and(removed).with_context(|| format!("{} cannot be written", file.display()))?;
    Ok(())
}

/// Writes an identity; one that is there already is moved out of the way.
fn keep(identity: &Identity, file: &Path) -> Result<(), Failure> {
    let draft = file.with_extension("pem.joined");
    identity.write(&draft)?;
    if file.exists() {
        let mut names = (1_u32..).map(|number| file.with_extension(format!("{number}.pem")));
        let earlier =
            names.find(|earlier| !earlier.exists()).context("there are too many earlier identities")?;
        fs::rename(file, &earlier)
            .with_context(|| format!("{} cannot be kept as {}", file.display(), earlier.display()))?;
        tell!("farmctl: the identity that was there is kept as {}", earlier.display());
    }
    fs::rename(&draft, file).with_context(|| {
        format!("your identity is {}; it cannot be moved to {}", draft.display(), file.display())
    })?;
    Ok(())
}

/// Runs one of the verbs of tokens.
pub(crate) async fn token(verb: &TokenVerb, target: &Target<'_>, format: Format) -> Result<(), Failure> {
    let admin = Admin::new(target.existing().await?);
    match verb {
        TokenVerb::Create { role, name, expires, uses, project } => {
            let role = match role {
                MemberRole::Node => Role::Node,
                MemberRole::App => Role::App,
                MemberRole::Operator => Role::Operator,
            };
            let invitation = Invitation {
                role,
                name: name.clone(),
                lifetime: *expires,
                uses: *uses,
                project: project.clone(),
            };
            let (id, token) = admin.create_token(&invitation).await?;
            let made = json!({
                "id": id,
                "token": token.to_string(),
                "role": role.to_string(),
                "name": name,
                "expires_s": unix_now() + expires.as_secs(),
                "uses": uses,
                "project": project,
            });
            // The token alone: scripts take it as it is.
            output::print(&made, format, |_, _| format!("{token}\n"))
        }
        TokenVerb::Ls { output } => {
            let tokens: Vec<Value> = admin.tokens().await?.iter().map(shown).collect();
            output::print(&tokens, output.unwrap_or(format), |tokens, _| tokens_table(tokens))
        }
        TokenVerb::Revoke { id } => {
            admin.revoke_token(*id).await?;
            output::print_text(&format!("token {id} is taken back\n"))
        }
    }
}

fn shown(token: &TokenStatus) -> Value {
    json!({
        "id": token.id,
        "role": token.role,
        "name": Some(&token.name).filter(|name| !name.is_empty()),
        "expires_s": token.expires_s,
        "uses_left": token.uses_left,
        "maker": token.maker,
        "project": Some(&token.project).filter(|project| !project.is_empty()),
    })
}

fn tokens_table(tokens: &[Value]) -> String {
    if tokens.is_empty() {
        return "no token can be used: make one with `farmctl token create node|app|operator`\n".to_owned();
    }
    let text = |value: &Value| value.as_str().map_or_else(String::new, printable);
    let mut table = output::table(["TOKEN", "ROLE", "NAME", "PROJECT", "EXPIRES IN", "USES LEFT", "MADE BY"]);
    for token in tokens {
        let seconds = token["expires_s"].as_u64().unwrap_or(0).saturating_sub(unix_now());
        let minutes = Duration::from_secs(seconds).as_secs().div_ceil(60);
        table.add_row([
            token["id"].to_string(),
            text(&token["role"]),
            text(&token["name"]),
            text(&token["project"]),
            format!("{minutes} min"),
            token["uses_left"].to_string(),
            text(&token["maker"]),
        ]);
    }
    format!("{table}\n")
}

fn shown_member(member: &MemberStatus) -> Value {
    json!({
        "member": member.uri,
        "project": Some(&member.project).filter(|project| !project.is_empty()),
    })
}

/// One in a line, and behind it its project, if that is another than `default`.
fn members_lines(members: &[Value]) -> String {
    let line = |member: &Value| {
        let text = |value: &Value| value.as_str().map_or_else(String::new, printable);
        let (uri, project) = (text(&member["member"]), text(&member["project"]));
        match project.as_str() {
            "" | DEFAULT_PROJECT => uri + "\n",
            project => format!("{uri}  {project}\n"),
        }
    };
    members.iter().map(line).collect()
}

/// Runs one of the verbs of members.
pub(crate) async fn member(verb: &MemberVerb, target: &Target<'_>, format: Format) -> Result<(), Failure> {
    let admin = Admin::new(target.existing().await?);
    match verb {
        MemberVerb::Ls { output } => {
            let members: Vec<Value> = admin.members().await?.iter().map(shown_member).collect();
            output::print(&members, output.unwrap_or(format), |members, _| members_lines(members))
        }
        MemberVerb::Expel { member } => {
            admin.expel(member).await?;
            output::print_text(&format!("{} is no member any more\n", printable(member)))
        }
    }
}
