//! The start and the end of the server.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use axum::middleware::map_response;
use axum::response::Response;
use axum::serve::{Listener, ListenerExt};
use gleaner_base::{Exit, Failure};
use gleaner_fleet::entrance::Entrance;
use rustix::net::sockopt::set_tcp_user_timeout;
use rustls::ServerConfig;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{Semaphore, watch};
use tokio::task::JoinSet;

use crate::attempts::{AccountChanges, VehicleLimits, WrongSecrets};
use crate::authority::Authorities;
use crate::bus::{Bus, BusAddress};
use crate::clips::ClipFiles;
use crate::cloud::{Cloud, STORED_FRAMES_MAX};
use crate::counts::COUNTS;
use crate::folder::{DataFolder, FolderLock};
use crate::hub::Hub;
use crate::objects::Objects;
use crate::place::FilePlace;
use crate::readers::Readers;
use crate::records::ChunkFiles;
use crate::s3::S3Bucket;
use crate::store::{ClipBounds, CloudStore, Retention, now};
use crate::ticks::ticks;
use crate::{clips, objects, people, records, replicas, tails, vehicles};

/// Maximum number of open connections of people, and of vehicles: a whole fleet has another one
/// for the files of a deployment. With few descriptors, there are fewer.
const PEOPLE_MAX: usize = 1000;
const VEHICLES_MAX: usize = 40_000;
/// Maximum number of connections that have not shown a vehicle's certificate yet. A vehicle needs
/// less than a second, so 1,536 of a fleet behind one address can begin in that time.
const STRANGERS_MAX: usize = 1536;
/// Descriptors that connections and files leave to the database, the log and short reads.
const DESCRIPTORS_KEPT: usize = 64;
/// Time after which a connection ends whose other side takes no byte, in ms.
const UNREAD_MS: u32 = if cfg!(test) { 1000 } else { 60_000 };
/// Interval at which times of signs of life are stored.
const SEEN_INTERVAL: Duration = Duration::from_secs(30);
const WAVES_INTERVAL: Duration = Duration::from_secs(2);
/// Time after which the server's certificate is made again, in s, and the interval of looks: a
/// clock that was set by more has made one with a wrong end.
const CERTIFICATE_S: i64 = 30 * 86_400;
const CERTIFICATE_LOOKS: Duration = Duration::from_secs(60);

/// Settings of the server, which are the arguments of `gleaner-cloud serve`.
#[derive(clap::Args, Debug, Clone)]
pub struct ServeOptions {
    /// Folder of everything that survives a restart
    #[arg(long, value_name = "DIR")]
    pub data: PathBuf,
    /// Database of a PostgreSQL server, as postgres://USER@HOST/DATABASE, with the password in
    /// PGPASSWORD [default: a file in the folder]
    #[arg(long, value_name = "URL")]
    pub store: Option<String>,
    /// NATS server by which several processes over one database wake each other, as
    /// nats://HOST:PORT, with NATS_USER and NATS_PASSWORD
    #[arg(long, value_name = "URL")]
    pub bus: Option<String>,
    /// Bucket of an object store for files, as s3://BUCKET/PREFIX, with AWS_ACCESS_KEY_ID,
    /// AWS_SECRET_ACCESS_KEY and AWS_ENDPOINT_URL; with it, several processes can serve one
    /// database [default: the folder]
    #[arg(long, value_name = "URL")]
    pub objects: Option<String>,
    /// Address of the API and the page for people, without TLS
    #[arg(long, value_name = "ADDRESS", default_value = "127.0.0.1:8080")]
    pub people: SocketAddr,
    /// Address for vehicles, with TLS
    #[arg(long, value_name = "ADDRESS", default_value = "127.0.0.1:8443")]
    pub vehicles: SocketAddr,
    /// Address for vehicles as enrolments state it, if it differs from --vehicles
    #[arg(long, value_name = "HOST:PORT")]
    pub name: Option<String>,
    /// Days for which records of vehicles are kept, unless there are too many; 0 for any time
    #[arg(long = "keep-records", value_name = "DAYS", default_value_t = 30)]
    pub keep_records_days: u32,
    /// Serve people without TLS also at an address that other machines can reach
    #[arg(long = "insecure-people")]
    pub is_insecure: bool,
    /// Count the limits of people by the last address in the header X-Forwarded-For, which a
    /// proxy on this machine has to add to each request
    #[arg(long = "behind-proxy")]
    pub is_behind_proxy: bool,
}

impl ServeOptions {
    /// Returns settings of a server with a folder, at any two free ports of this machine.
    pub fn local(data: PathBuf) -> Self {
        let any = ([127, 0, 0, 1], 0).into();
        Self {
            data,
            store: None,
            bus: None,
            objects: None,
            people: any,
            vehicles: any,
            name: None,
            keep_records_days: 30,
            is_insecure: false,
            is_behind_proxy: false,
        }
    }

    /// Refuses to serve people of other machines without TLS, unless that is permitted.
    fn check_people(&self) -> Result<(), Failure> {
        if self.people.ip().is_loopback() || self.is_insecure {
            return Ok(());
        }
        let message = format!("people are not served at {} without TLS", self.people);
        Err(Failure::new(Exit::Denied, message).with_help(
            "use a loopback address and put a proxy with TLS before it, or add \
             --insecure-people in a network that you trust",
        ))
    }

    /// Refuses a bus and shared files without a database that replicas share.
    fn check_shared(&self) -> Result<(), Failure> {
        if self.store.is_some() || (self.bus.is_none() && self.objects.is_none()) {
            return Ok(());
        }
        let message = "--bus and --objects are for several processes over one database";
        Err(Failure::new(Exit::Usage, message)
            .with_help("add --store postgres://USER@HOST/DATABASE, or leave them out"))
    }
}

pub struct CloudServer {
    pub people: SocketAddr,
    pub vehicles: SocketAddr,
    /// The one-time code of an administrator, unless one has a valid token.
    pub code: Option<String>,
    cloud: Arc<Cloud>,
    failed: watch::Receiver<Option<Failure>>,
    stop: watch::Sender<bool>,
    entrances: JoinSet<()>,
    chores: JoinSet<()>,
    _lock: FolderLock,
}

impl CloudServer {
    /// Starts a server.
    ///
    /// # Errors
    ///
    /// A failure that names the folder, the file or the address that cannot be used.
    pub async fn start(options: &ServeOptions) -> Result<Self, Failure> {
        options.check_people()?;
        let folder = DataFolder::create(&options.data)?;
        let lock = folder.lock()?;
        options.check_shared()?;
        let bus = options.bus.as_deref().map(BusAddress::parse).transpose()?;
        let bucket = options.objects.as_deref().map(S3Bucket::parse).transpose()?;
        let objects = bucket.as_ref().map(S3Bucket::url).unwrap_or_default();
        let address = folder.store(options.store.as_deref())?;
        let store = CloudStore::open(&address).await?;
        if !folder.has_authorities() {
            // Those of a new folder would be others than the database has.
            store.tie(None, &objects).await?;
        }
        let authorities = Authorities::open(&folder)?;
        let authority = gleaner_trust::sha256(authorities.server_pem().as_bytes());
        store.tie(Some(authority.as_str()), &objects).await?;
        folder.keep(&address)?;
        if let Some(seq) = store.first_changed_entry().await? {
            tracing::error!(seq, "the audit trail was changed: an entry is not as it was written");
        }
        let people_listener = listen(options.people, "--people").await?;
        let vehicles_listener = listen(options.vehicles, "--vehicles").await?;
        let (people, vehicles) =
            (local(&people_listener, "--people")?, local(&vehicles_listener, "--vehicles")?);
        let address = options.name.clone().unwrap_or_else(|| vehicles.to_string());
        let host = host(&address)?.to_owned();
        store.begin_lease(&lock.former, bucket.is_none()).await?;
        lock.note(store.replica()).map_err(|error| {
            let action = format!("cannot write in `{}`", options.data.display());
            Failure::caused_by(Exit::Internal, action, &error)
        })?;
        let mut chores = JoinSet::new();
        let (bus, hints) = match bus {
            None => (Bus::default(), None),
            Some(address) => {
                let (bus, hints) = address.connect(&authority.as_str()[..16], &mut chores).await?;
                (bus, Some(hints))
            }
        };
        let place = |folder, start| FilePlace::open(folder, bucket.as_ref(), start);
        let (tls, tls_config) = watch::channel(authorities.server_config(&host)?);
        let code = store.invite_first().await?.map(|invitation| invitation.code);
        let cloud = Arc::new(Cloud {
            health: Default::default(),
            store,
            objects: Objects::new(place(folder.objects(), "objects/")?),
            clips: Arc::new(ClipFiles::new(place(folder.clips(), "clips/")?, ClipBounds::DEFAULT)),
            chunks: ChunkFiles::new(place(folder.records(), "records/")?),
            hub: Hub::new(bus),
            authorities,
            wrong_secrets: WrongSecrets::default(),
            limits: VehicleLimits::default(),
            account_changes: AccountChanges::default(),
            readers: Readers::new("streams of records"),
            page_readers: Readers::new("pages of records"),
            transfers: Readers::bounded("transfers of files", descriptors(1)),
            tails: Arc::default(),
            stored_frames: Semaphore::new(STORED_FRAMES_MAX),
            retention: Retention::DEFAULT,
            keep_records_days: options.keep_records_days,
            address,
        });
        let (stop, stopped) = watch::channel(false);
        let (failure, failed) = watch::channel(None);
        let mut entrances = JoinSet::new();
        let (stopping, behind_proxy) = (stopped.clone(), options.is_behind_proxy);
        entrances.spawn(people_entrance(people_listener, &cloud, behind_proxy, stopping).serve());
        let entrance = vehicles_entrance(vehicles_listener, &cloud, tls_config, stopped);
        entrances.spawn(entrance.serve());
        // Each has a task of its own: one that waits for the database must not hold it up.
        if cloud.store.is_shared() {
            let (working, is_alone) = (Arc::clone(&cloud), bucket.is_none());
            chores.spawn(async move { replicas::keep_lease(&working, is_alone, failure).await });
            let working = Arc::clone(&cloud);
            chores.spawn(async move { replicas::follow(&working, hints).await });
        }
        spawn_chores(&mut chores, &cloud);
        let working = Arc::clone(&cloud);
        chores.spawn(async move { renew_certificate(&working, &host, &tls).await });
        Ok(Self { people, vehicles, code, cloud, failed, stop, entrances, chores, _lock: lock })
    }

    /// Waits for the reason for which the server cannot go on.
    pub async fn failed(&mut self) -> Failure {
        loop {
            if let Some(failure) = self.failed.borrow_and_update().clone() {
                return failure;
            }
            if self.failed.changed().await.is_err() {
                // A server with a database of its own has none.
                std::future::pending::<()>().await;
            }
        }
    }

    /// Stops the server: vehicles are asked to come back later, and open requests are answered.
    pub async fn stop(self) {
        let Self { cloud, stop, entrances, mut chores, .. } = self;
        chores.shutdown().await;
        stop.send_replace(true);
        cloud.hub.stop();
        entrances.join_all().await;
        store_seen(&cloud).await;
        if let Err(error) = cloud.store.end_lease().await {
            tracing::warn!(reason = error.reason(), "vehicles count as connected for a while");
        }
        cloud.store.close().await;
    }
}

fn people_entrance(
    listener: TcpListener,
    cloud: &Arc<Cloud>,
    is_behind_proxy: bool,
    stop: watch::Receiver<bool>,
) -> Entrance<impl Listener<Addr = SocketAddr>> {
    let listener = listener.tap_io(tune);
    let most = PEOPLE_MAX.min(descriptors(2));
    let router = people::router(cloud).layer(map_response(counted));
    let plain = Entrance::plain(listener, ("people connections", most), router, stop);
    Entrance { is_behind_proxy, ..plain }
}

fn vehicles_entrance(
    listener: TcpListener,
    cloud: &Arc<Cloud>,
    tls: watch::Receiver<Arc<ServerConfig>>,
    stop: watch::Receiver<bool>,
) -> Entrance<impl Listener<Addr = SocketAddr>> {
    let listener = listener.tap_io(tune);
    let strangers = ("vehicle connections", STRANGERS_MAX.min(descriptors(2)));
    let router = vehicles::router(cloud).layer(map_response(counted));
    let plain = Entrance::plain(listener, strangers, router, stop);
    Entrance { tls: Some(tls), known: VEHICLES_MAX.min(descriptors(10)), ..plain }
}

/// Returns so many sixteenths of the descriptors for connections and files, which take 15 of them:
/// without the others, no record could be stored.
fn descriptors(sixteenths: usize) -> usize {
    gleaner_base::open_files_max().saturating_sub(DESCRIPTORS_KEPT) / 16 * sixteenths
}

/// Makes a connection send at once, and end if its other side takes none of what is sent.
fn tune(stream: &mut TcpStream) {
    // One without these works, too.
    let _ = stream.set_nodelay(true);
    let _ = set_tcp_user_timeout(&*stream, UNREAD_MS);
}

async fn counted(answer: Response) -> Response {
    COUNTS.answered(answer.status().as_u16());
    answer
}

/// Spawns the chores that a cloud has with and without replicas.
fn spawn_chores(chores: &mut JoinSet<()>, cloud: &Arc<Cloud>) {
    chores.spawn(clips::clean(Arc::clone(cloud)));
    chores.spawn(objects::collect(Arc::clone(cloud)));
    chores.spawn(records::keep(Arc::clone(cloud)));
    chores.spawn(tails::keep(Arc::clone(cloud)));
    chores.spawn(keep_seen(Arc::clone(cloud)));
    chores.spawn(advance_waves(Arc::clone(cloud)));
}

/// Stores the last signs of life, for as long as this process runs.
async fn keep_seen(cloud: Arc<Cloud>) {
    let mut ticks = ticks(SEEN_INTERVAL);
    loop {
        ticks.tick().await;
        store_seen(&cloud).await;
    }
}

async fn store_seen(cloud: &Cloud) {
    if let Err(error) = cloud.store.seen(&cloud.hub.take_seen()).await {
        tracing::warn!(reason = error.reason(), "the last signs of life are not stored");
    }
}

/// Advances the waves of releases, for as long as this process runs.
async fn advance_waves(cloud: Arc<Cloud>) {
    let mut ticks = ticks(WAVES_INTERVAL);
    loop {
        ticks.tick().await;
        match cloud.store.advance_waves().await {
            Ok(changed) => cloud.hub.wake(&changed),
            Err(error) => tracing::warn!(reason = error.reason(), "waves do not go on"),
        }
    }
}

/// Makes the server's certificate again and again, for as long as this process runs.
async fn renew_certificate(cloud: &Cloud, host: &str, tls: &watch::Sender<Arc<ServerConfig>>) {
    let (mut ticks, mut made) = (ticks(CERTIFICATE_LOOKS), now());
    loop {
        ticks.tick().await;
        if (now() - made).abs() < CERTIFICATE_S {
            continue;
        }
        made = now();
        match cloud.authorities.server_config(host) {
            Ok(config) => drop(tls.send_replace(config)),
            Err(failure) => tracing::error!("{failure}"),
        }
    }
}

async fn listen(address: SocketAddr, option: &str) -> Result<TcpListener, Failure> {
    TcpListener::bind(address).await.map_err(|error| {
        Failure::caused_by(Exit::Usage, format!("cannot listen on {address}"), &error)
            .with_help(format!("choose another address with {option}"))
    })
}

fn local(listener: &TcpListener, option: &str) -> Result<SocketAddr, Failure> {
    listener.local_addr().map_err(|error| {
        Failure::caused_by(Exit::Internal, format!("{option} has no address"), &error)
    })
}

/// Returns the host of `HOST:PORT`.
fn host(address: &str) -> Result<&str, Failure> {
    let parts = address.rsplit_once(':').filter(|(_, port)| port.parse::<u16>().is_ok());
    let host = parts.map(|(host, _)| host.trim_start_matches('[').trim_end_matches(']'));
    host.filter(|host| !host.is_empty()).ok_or_else(|| {
        let shown = gleaner_base::excerpt(address);
        Failure::new(Exit::Usage, format!("`{shown}` is no address of a cloud"))
            .with_help("name a host and a port with --name, as in cloud.example.org:8443")
    })
}

#[cfg(test)]
mod tests {
    use std::io::ErrorKind;

    use tokio::io;
    use tokio::time::timeout;

    use super::*;

    #[tokio::test]
    async fn a_connection_whose_other_side_reads_nothing_ends() {
        let listener = TcpListener::bind(("127.0.0.1", 0)).await.unwrap();
        let _reader = TcpStream::connect(listener.local_addr().unwrap()).await.unwrap();
        let mut stream = listener.tap_io(tune).accept().await.0;
        // Once all buffers are full, a write waits for the other side.
        let end = async { io::copy(&mut io::repeat(0), &mut stream).await };
        let end = timeout(Duration::from_secs(60), end).await.expect("it has not ended");
        assert_eq!(end.unwrap_err().kind(), ErrorKind::TimedOut);
    }
}
