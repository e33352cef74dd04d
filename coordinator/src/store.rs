//! What the coordinator keeps over its own death: its epoch, and, in a secured farm, who is a member and who may become one.
//! Plans, load and fairness are rebuilt from re-registration and never stored; what crashes and devices taught is (`soft`).
//!
//! A redb database: what a method has returned is on disk, and after a crash the store is what was committed last.

mod projects;
mod soft;

use std::{
    any::Any,
    fs, io,
    ops::Not as _,
    panic::catch_unwind,
    path::{Path, PathBuf},
    sync::{Arc, PoisonError, RwLock},
    time::SystemTime,
};

use farm_core::id::Epoch;
use proto::trust::{Member, Membership, Principal, Role, TrustError};
use redb::{
    Database, DatabaseError, ReadTransaction, ReadableDatabase as _, ReadableTable as _,
    ReadableTableMetadata as _, TableDefinition, TableError, WriteTransaction,
};
use serde::{Deserialize, Serialize};
use thiserror::Error;

use self::{
    projects::{BELONGING, PROJECTS},
    soft::{SPEEDS, STOPPED},
};
use crate::{StartError, lead::Lead, numbered::Numbered};

/// The database in a state directory by which nobody has led yet; later ones have the term of their leader in the name.
const FILE: &str = "control.redb";
/// Those, and what is not one yet.
const DATABASES: Numbered = Numbered { before: "control-", after: ".redb" };
const COPIES: Numbered = Numbered { before: "control-", after: ".copy" };
/// What it keeps in memory, in bytes: it is read at joins and new sessions.
const CACHE_BYTES: usize = 1 << 20;
/// Where versions before the database kept the epoch.
const EPOCH_FILE: &str = "epoch";
/// From 1970-01-01 to 2026-01-01: 56 years, 14 of them leap years.
const SECONDS_1970_TO_2026: u64 = (56 * 365 + 14) * 86_400;
/// Most tokens that can be used at a time.
const MAX_TOKENS: u64 = 10_000;
/// Most members.
const MAX_MEMBERS: u64 = 100_000;

/// Numbers: the epoch begun last, and the last token's.
const NUMBERS: TableDefinition<'_, &str, u64> = TableDefinition::new("numbers");
const EPOCH: &str = "epoch";
const LAST_TOKEN: &str = "last-token";
/// Tokens as JSON, by the blake3 of their secrets.
const TOKENS: TableDefinition<'_, &[u8], &str> = TableDefinition::new("tokens");
/// The blake3 of members' public keys, by their URIs.
const MEMBERS: TableDefinition<'_, &str, &[u8]> = TableDefinition::new("members");

/// A join token, without its secret.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Token {
    /// Its number.
    pub(crate) id: u64,
    /// What who joins becomes.
    pub(crate) role: String,
    /// The name that who joins gets; empty: any that nobody has.
    pub(crate) name: String,
    /// Until when it can be used, in seconds since 1970.
    pub(crate) expires_s: u64,
    /// How often still.
    pub(crate) uses_left: u32,
    /// Who made it.
    pub(crate) maker: String,
    /// The project of who joins; empty: none, or `default`.
    #[serde(default)]
    pub(crate) project: String,
}

/// The store did not do what it was asked for.
#[derive(Debug, Error)]
pub(crate) enum StoreError {
    /// The caller may not have that.
    #[error("{0}")]
    Denied(String),
    /// Something of the farm stands against it.
    #[error("{0}")]
    Refused(String),
    /// The disk, or the database.
    #[error("the control store: {0}")]
    Broken(String),
    /// Another coordinator may lead.
    #[error("not kept: {0}")]
    Superseded(String),
}

impl From<TrustError> for StoreError {
    fn from(error: TrustError) -> Self {
        Self::Denied(error.to_string())
    }
}

/// The database's own errors, which are many.
fn broken(error: impl Into<redb::Error>) -> StoreError {
    StoreError::Broken(error.into().to_string())
}

/// Lives of a coordinator without a state directory are told apart by the wall clock, so that ids of an earlier life on the same
/// address are never given out again. Two starts within one second, or a clock set back between them, are what [`Store`] is for.
pub(crate) fn epoch_by_the_clock() -> Epoch {
    let since_1970 = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
    let seconds = since_1970.as_secs().saturating_sub(SECONDS_1970_TO_2026).max(1);
    // Full in the year 2162.
    Epoch(u32::try_from(seconds).unwrap_or(u32::MAX))
}

/// State in a directory of its own, locked for as long as this lives.
#[derive(Debug)]
pub(crate) struct Store {
    path: PathBuf,
    /// `None` after the disk failed: redb takes nothing more then (a full disk is enough), and is opened anew.
    ///
    /// A lock, not an owner: sessions read side by side, each on a thread that may block. Held for a transaction.
    database: RwLock<Option<Database>>,
    /// By what right it is written; `None`: nobody else can.
    lead: Option<Arc<Lead>>,
}

impl Store {
    /// Opens the latest one; makes the directory and the database if they are not there. Refuses what another coordinator uses.
    pub(crate) fn open(directory: &Path) -> Result<Self, StartError> {
        fs::create_dir_all(directory).map_err(|error| fault(directory, &error))?;
        let latest = || DATABASES.latest(directory).map_err(|error| fault(directory, &error));
        let term = latest()?;
        let store = Self::open_at(directory, path_of(directory, term))?;
        // Somebody who leads since we looked has moved it, and we have made another one.
        if latest()? == term { Ok(store) } else { Err(StartError::InUse { path: directory.to_owned() }) }
    }

    fn open_at(directory: &Path, path: PathBuf) -> Result<Self, StartError> {
        // The database asserts, deep inside, what its file's header says: on a file that was cut or changed it panics.
        let opened = catch_unwind(|| Self::open_database(directory, &path));
        let database = opened.unwrap_or_else(|panic| Err(fault(&path, &damage(panic.as_ref()))))?;
        let store = Self { path, database: RwLock::new(Some(database)), lead: None };
        store.begin(directory)?;
        Ok(store)
    }

    /// Makes it the one of a term, which is later than all others: nobody else has it open.
    pub(crate) fn led_by(mut self, directory: &Path, lead: Arc<Lead>) -> Result<Self, StartError> {
        let path = path_of(directory, lead.term());
        let moved = fs::rename(&self.path, &path).and_then(|()| fs::File::open(directory)?.sync_all());
        moved.map_err(|error| fault(&self.path, &error))?;
        (self.path, self.lead) = (path, Some(lead));
        Ok(self)
    }

    /// Opens a copy of the latest one, as that of a term: a predecessor may have the other open, and what it still writes there
    /// reaches nobody. It commits nothing that it says it did from when the term was taken (`Lead::holds`).
    pub(crate) fn copied_by(directory: &Path, lead: Arc<Lead>) -> Result<Self, StartError> {
        let path = path_of(directory, lead.term());
        let copy = COPIES.path(directory, lead.term());
        let copied = || -> io::Result<()> {
            let source = path_of(directory, DATABASES.latest(directory)?);
            // What a start left behind that came no further is the only one, and stays.
            if source != path {
                lead.copies_to(&path);
            }
            if source.try_exists()? {
                fs::copy(&source, &copy)?;
                fs::File::open(&copy)?.sync_all()?;
                fs::rename(&copy, &path)?;
            }
            fs::File::open(directory)?.sync_all()
        };
        if let Err(error) = copied() {
            // What is not there is as good as removed.
            let _ = fs::remove_file(&copy);
            return Err(fault(&path, &error));
        }
        Ok(Self { lead: Some(lead), ..Self::open_at(directory, path)? })
    }

    pub(crate) const fn lead(&self) -> Option<&Arc<Lead>> {
        self.lead.as_ref()
    }

    /// Opens the database and reads it whole: damage shows at the start, not when somebody joins.
    fn open_database(directory: &Path, path: &Path) -> Result<Database, StartError> {
        let opened = Database::builder().set_cache_size(CACHE_BYTES).create(path);
        let mut database = opened.map_err(|error| match error {
            DatabaseError::DatabaseAlreadyOpen => StartError::InUse { path: directory.to_owned() },
            error => fault(path, &error),
        })?;
        let before = everything(&database);
        match database.check_integrity() {
            Ok(true) => Ok(database),
            // It mended something. Mostly its count of free pages, which does not survive every sequence of changes.
            Ok(false)
                if before.is_ok_and(|before| everything(&database).is_ok_and(|after| after == before)) =>
            {
                Ok(database)
            }
            Ok(false) => Err(fault(
                path,
                &"was damaged, and is now what it was some changes ago: look at members and tokens after the next start, or \
                  restore it",
            )),
            Err(error) => Err(fault(path, &error)),
        }
    }

    /// Reads from the state that was committed last.
    fn read<T>(&self, work: impl FnOnce(&ReadTransaction) -> Result<T, StoreError>) -> Result<T, StoreError> {
        self.with(|database| work(&database.begin_read().map_err(broken)?))
    }

    /// Changes something: all that `work` did is on disk when this returns, or nothing of it ever will be.
    fn write<T>(
        &self,
        work: impl FnOnce(&WriteTransaction) -> Result<T, StoreError>,
    ) -> Result<T, StoreError> {
        self.check_lead()?;
        let done = self.with(|database| {
            let transaction = database.begin_write().map_err(broken)?;
            let done = work(&transaction)?;
            transaction.commit().map_err(broken)?;
            Ok(done)
        })?;
        // Else a successor may have read before it was there.
        self.check_lead()?;
        Ok(done)
    }

    fn check_lead(&self) -> Result<(), StoreError> {
        self.lead.as_ref().map_or(Ok(()), |lead| lead.holds()).map_err(StoreError::Superseded)
    }

    fn with<T>(&self, work: impl FnOnce(&Database) -> Result<T, StoreError>) -> Result<T, StoreError> {
        self.open_again()?;
        let done = {
            let open = self.database.read().unwrap_or_else(PoisonError::into_inner);
            work(open.as_ref().ok_or_else(|| StoreError::Broken("it is closed".to_owned()))?)
        };
        if let Err(StoreError::Broken(reason)) = &done {
            tracing::error!(reason, "the control store failed; it is opened anew for what comes next");
            self.database.write().unwrap_or_else(PoisonError::into_inner).take();
        }
        done
    }

    /// Opens the database, if it failed.
    fn open_again(&self) -> Result<(), StoreError> {
        if self.database.read().unwrap_or_else(PoisonError::into_inner).is_some() {
            return Ok(());
        }
        let mut closed = self.database.write().unwrap_or_else(PoisonError::into_inner);
        if closed.is_none() {
            let opened = Database::builder().set_cache_size(CACHE_BYTES).create(&self.path);
            *closed = Some(opened.map_err(broken)?);
        }
        Ok(())
    }

    /// Makes the tables, and takes over the epoch of an earlier version.
    fn begin(&self, directory: &Path) -> Result<(), StartError> {
        let earlier = earlier_epoch(directory)?;
        let begun = self.write(|transaction| {
            let mut numbers = transaction.open_table(NUMBERS).map_err(broken)?;
            transaction.open_table(TOKENS).map_err(broken)?;
            transaction.open_table(MEMBERS).map_err(broken)?;
            transaction.open_table(PROJECTS).map_err(broken)?;
            transaction.open_table(BELONGING).map_err(broken)?;
            transaction.open_table(STOPPED).map_err(broken)?;
            transaction.open_table(SPEEDS).map_err(broken)?;
            let known = numbers.get(EPOCH).map_err(broken)?.is_some();
            if let Some(earlier) = earlier.filter(|_| !known) {
                numbers.insert(EPOCH, u64::from(earlier)).map_err(broken)?;
            }
            Ok(())
        });
        begun.map_err(|error| fault(&self.path, &error))
    }

    /// Reads everything once.
    pub(crate) fn read_all(&self) -> Result<(), StartError> {
        let read = || {
            self.tokens(0)?;
            self.members()?;
            self.quotas()?;
            self.belonging()?;
            self.restored()?;
            self.read(|transaction| {
                let numbers = transaction.open_table(NUMBERS).map_err(broken)?;
                numbers.get(EPOCH).map_err(broken)?;
                Ok::<_, StoreError>(())
            })
        };
        read().map_err(|error| fault(&self.path, &error))
    }

    /// Begins a new life: larger than every earlier one, and durable when this returns.
    pub(crate) fn begin_epoch(&self) -> Result<Epoch, StartError> {
        let next = self.count(EPOCH).map_err(|error| fault(&self.path, &error))?;
        u32::try_from(next).map(Epoch).map_err(|_| fault(&self.path, &"all epochs are used up"))
    }

    /// The next of one of the numbers, from 1.
    fn count(&self, what: &str) -> Result<u64, StoreError> {
        self.write(|transaction| {
            let mut numbers = transaction.open_table(NUMBERS).map_err(broken)?;
            let last = numbers.get(what).map_err(broken)?.map_or(0, |last| last.value());
            let next = last.saturating_add(1);
            numbers.insert(what, next).map_err(broken)?;
            Ok(next)
        })
    }

    /// Keeps a token under a number of its own, which it gives; forgets those that are over.
    pub(crate) fn add_token(&self, secret: &[u8], token: Token, now_s: u64) -> Result<u64, StoreError> {
        let id = self.count(LAST_TOKEN)?;
        self.write(|transaction| {
            projects::check_known(transaction, &token.project)?;
            let mut tokens = transaction.open_table(TOKENS).map_err(broken)?;
            tokens
                .retain(|_, text| parse(text).is_ok_and(|token| token.expires_s > now_s))
                .map_err(broken)?;
            if tokens.len().map_err(broken)? >= MAX_TOKENS {
                return Err(StoreError::Refused(format!(
                    "{MAX_TOKENS} tokens are there already; take some back"
                )));
            }
            let text = text_of(&Token { id, ..token })?;
            tokens.insert(digest(secret).as_slice(), text.as_str()).map_err(broken)?;
            Ok(id)
        })
    }

    /// The tokens that can be used still, by number.
    pub(crate) fn tokens(&self, now_s: u64) -> Result<Vec<Token>, StoreError> {
        self.read(|transaction| {
            let table = transaction.open_table(TOKENS).map_err(broken)?;
            let mut tokens = Vec::new();
            for entry in table.iter().map_err(broken)? {
                let (_, text) = entry.map_err(broken)?;
                tokens.push(parse(text.value())?);
            }
            tokens.retain(|token: &Token| token.expires_s > now_s);
            tokens.sort_unstable_by_key(|token| token.id);
            Ok(tokens)
        })
    }

    /// Takes a token back; whether it was there.
    pub(crate) fn remove_token(&self, id: u64) -> Result<bool, StoreError> {
        self.write(|transaction| {
            let mut removed = false;
            let mut tokens = transaction.open_table(TOKENS).map_err(broken)?;
            tokens
                .retain(|_, text| {
                    let this = parse(text).is_ok_and(|token| token.id == id);
                    removed |= this;
                    !this
                })
                .map_err(broken)?;
            Ok(removed)
        })
    }

    /// Uses a token once: `issue` makes the membership for role and name, and only if it does is the token used. A name that
    /// somebody has is given to another key only by a token for that name.
    pub(crate) fn join(
        &self,
        secret: &[u8],
        wanted: &str,
        now_s: u64,
        issue: impl FnOnce(Role, &str) -> Result<Membership, TrustError>,
    ) -> Result<Membership, StoreError> {
        // One answer for what never was, is over, was used up or was taken back: strangers learn nothing.
        let unknown = || StoreError::Denied("this token cannot be used (any more)".to_owned());
        self.write(|transaction| {
            let mut tokens = transaction.open_table(TOKENS).map_err(broken)?;
            let key = digest(secret);
            let token =
                tokens.get(key.as_slice()).map_err(broken)?.map(|text| parse(text.value())).transpose()?;
            let mut token = token.filter(|token| token.expires_s > now_s).ok_or_else(unknown)?;
            let name = match (token.name.as_str(), wanted) {
                ("", "") => return Err(StoreError::Denied("the token has no name: choose one".to_owned())),
                ("", wanted) => wanted.to_owned(),
                (name, wanted) if wanted.is_empty() || wanted == name => name.to_owned(),
                (name, _) => return Err(StoreError::Denied(format!("the token is for the name {name:?}"))),
            };
            let membership = issue(token.role.parse()?, &name)?;
            let member = Member::of_certificate(&membership.certificate_der)?;
            let mut members = transaction.open_table(MEMBERS).map_err(broken)?;
            enrol(&mut members, &member, !token.name.is_empty())?;
            projects::put(transaction, &member.principal, &token.project)?;
            token.uses_left = token.uses_left.saturating_sub(1);
            if token.uses_left == 0 {
                tokens.remove(key.as_slice()).map_err(broken)?;
            } else {
                tokens.insert(key.as_slice(), text_of(&token)?.as_str()).map_err(broken)?;
            }
            Ok(membership)
        })
    }

    /// Makes somebody a member without a token.
    pub(crate) fn admit(&self, member: &Member) -> Result<(), StoreError> {
        self.write(|transaction| {
            enrol(&mut transaction.open_table(MEMBERS).map_err(broken)?, member, true)?;
            Ok(())
        })
    }

    /// Whether somebody is a member under this key.
    pub(crate) fn is_member(&self, member: &Member) -> Result<bool, StoreError> {
        self.read(|transaction| {
            let members = transaction.open_table(MEMBERS).map_err(broken)?;
            let known = members.get(member.principal.to_string().as_str()).map_err(broken)?;
            Ok(known.is_some_and(|key| key.value() == member.key))
        })
    }

    /// Ends a membership, and takes back the tokens that this member has made; whether it was one. Certificates live on, and
    /// are worth nothing here. The last operator stays: nobody else could make another.
    pub(crate) fn expel(&self, principal: &Principal) -> Result<bool, StoreError> {
        let uri = principal.to_string();
        self.write(|transaction| {
            let mut members = transaction.open_table(MEMBERS).map_err(broken)?;
            let mut operators = 0;
            for entry in members.iter().map_err(broken)? {
                let (member, _) = entry.map_err(broken)?;
                operators += usize::from(is_operator(member.value()));
            }
            if operators == 1 && is_operator(&uri) {
                return Err(StoreError::Refused(format!(
                    "{uri} is the only operator: make another one first"
                )));
            }
            let mut tokens = transaction.open_table(TOKENS).map_err(broken)?;
            tokens.retain(|_, text| parse(text).is_ok_and(|token| token.maker != uri)).map_err(broken)?;
            projects::put(transaction, principal, "")?;
            Ok(members.remove(uri.as_str()).map_err(broken)?.is_some())
        })
    }

    /// Whether the farm that this is the store of was ever secured.
    pub(crate) fn has_members(&self) -> bool {
        // One that cannot be read is no reason to let everyone in.
        self.members().is_ok_and(|members| members.is_empty()).not()
    }

    /// Forgets members, tokens and projects.
    pub(crate) fn clear(&self) -> Result<(), StoreError> {
        self.write(|transaction| {
            transaction.open_table(TOKENS).map_err(broken)?.retain(|_, _| false).map_err(broken)?;
            transaction.open_table(MEMBERS).map_err(broken)?.retain(|_, _| false).map_err(broken)?;
            transaction.open_table(BELONGING).map_err(broken)?.retain(|_, _| false).map_err(broken)?;
            transaction.open_table(PROJECTS).map_err(broken)?.retain(|_, _| false).map_err(broken)?;
            Ok(())
        })
    }

    /// The URIs of all members, in order.
    pub(crate) fn members(&self) -> Result<Vec<String>, StoreError> {
        self.read(|transaction| {
            let table = transaction.open_table(MEMBERS).map_err(broken)?;
            let uris =
                table.iter().map_err(broken)?.map(|entry| entry.map(|(uri, _)| uri.value().to_owned()));
            uris.collect::<Result<_, _>>().map_err(broken)
        })
    }
}

fn enrol(
    members: &mut redb::Table<'_, &str, &[u8]>,
    member: &Member,
    may_replace: bool,
) -> Result<(), StoreError> {
    let uri = member.principal.to_string();
    let taken = members.get(uri.as_str()).map_err(broken)?.is_some_and(|key| key.value() != member.key);
    if taken && !may_replace {
        return Err(StoreError::Refused(format!(
            "{uri} is there already: choose another name, or have a token made for this one"
        )));
    }
    if !taken && members.len().map_err(broken)? >= MAX_MEMBERS {
        return Err(StoreError::Refused(format!("the farm has {MAX_MEMBERS} members already")));
    }
    members.insert(uri.as_str(), member.key.as_slice()).map_err(broken)?;
    Ok(())
}

/// A key and its value, as bytes.
type Entry = (Vec<u8>, Vec<u8>);

/// All entries of all tables, in order.
fn everything(database: &Database) -> Result<Vec<Entry>, redb::Error> {
    fn absent<T>(opened: Result<T, TableError>) -> Result<Option<T>, redb::Error> {
        match opened {
            Ok(table) => Ok(Some(table)),
            Err(TableError::TableDoesNotExist(_)) => Ok(None),
            Err(error) => Err(error.into()),
        }
    }
    let transaction = database.begin_read()?;
    let mut entries = Vec::new();
    if let Some(numbers) = absent(transaction.open_table(NUMBERS))? {
        for entry in numbers.iter()? {
            let (key, value) = entry?;
            entries.push((key.value().into(), value.value().to_le_bytes().into()));
        }
    }
    if let Some(tokens) = absent(transaction.open_table(TOKENS))? {
        for entry in tokens.iter()? {
            let (key, value) = entry?;
            entries.push((key.value().into(), value.value().into()));
        }
    }
    if let Some(members) = absent(transaction.open_table(MEMBERS))? {
        for entry in members.iter()? {
            let (key, value) = entry?;
            entries.push((key.value().into(), value.value().into()));
        }
    }
    if let Some(stopped) = absent(transaction.open_table(STOPPED))? {
        for entry in stopped.iter()? {
            let (key, value) = entry?;
            entries.push((key.value().to_le_bytes().into(), value.value().into()));
        }
    }
    for texts in [SPEEDS, PROJECTS, BELONGING] {
        if let Some(texts) = absent(transaction.open_table(texts))? {
            for entry in texts.iter()? {
                let (key, value) = entry?;
                entries.push((key.value().into(), value.value().into()));
            }
        }
    }
    Ok(entries)
}

/// The database of a term; 0: before the first.
fn path_of(directory: &Path, term: u64) -> PathBuf {
    if term == 0 { directory.join(FILE) } else { DATABASES.path(directory, term) }
}

/// Removes the databases of terms before this one.
pub(crate) fn forget_before(directory: &Path, term: u64) {
    DATABASES.remove_before(directory, term);
    COPIES.remove_before(directory, term);
}

fn is_operator(uri: &str) -> bool {
    uri.parse().is_ok_and(|principal: Principal| principal.role == Role::Operator)
}

fn digest(secret: &[u8]) -> [u8; 32] {
    proto::codec::content_hash(secret).0
}

fn parse(text: &str) -> Result<Token, StoreError> {
    serde_json::from_str(text).map_err(|error| StoreError::Broken(error.to_string()))
}

fn text_of(token: &Token) -> Result<String, StoreError> {
    serde_json::to_string(token).map_err(|error| StoreError::Broken(error.to_string()))
}

/// The epoch that a version before the database left. Starting over at epoch 1 would let old attempts win over new ones: a file
/// that makes no sense is an error.
fn earlier_epoch(directory: &Path) -> Result<Option<u32>, StartError> {
    let path = directory.join(EPOCH_FILE);
    match fs::read(&path) {
        Ok(bytes) => {
            let epoch = std::str::from_utf8(&bytes).ok().and_then(|text| text.trim_end().parse().ok());
            let garbled =
                || fault(&path, &"does not hold an epoch; restore it, or remove it if no worker runs");
            epoch.map(Some).ok_or_else(garbled)
        }
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
        Err(error) => Err(fault(&path, &error)),
    }
}

/// What a panic of the database says.
fn damage(panic: &(dyn Any + Send)) -> String {
    let text = panic.downcast_ref::<String>().map(String::as_str);
    let text = text.or_else(|| panic.downcast_ref::<&str>().copied()).unwrap_or("no message");
    format!("is damaged; restore it, or remove it if no worker runs ({text})")
}

pub(crate) fn fault(path: &Path, reason: &dyn ToString) -> StartError {
    StartError::State { path: path.to_owned(), reason: reason.to_string() }
}

#[cfg(test)]
mod tests;
