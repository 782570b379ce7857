//! The start and the end of the server.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use axum::middleware::map_response;
use axum::response::Response;
use axum::serve::ListenerExt;
use gleaner_base::{Exit, Failure};
use gleaner_fleet::listener::BoundedListener;
use rustix::net::sockopt::set_tcp_user_timeout;
use rustls::ServerConfig;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::watch;
use tokio::task::JoinSet;

use crate::authority::Authorities;
use crate::bus::Bus;
use crate::cloud::{Cloud, descriptors};
use crate::counts::COUNTS;
use crate::folder::{DataFolder, FolderLock};
use crate::hub::Hub;
use crate::scaled::{BusAddress, S3Bucket};
use crate::store::CloudStore;
use crate::ticks::ticks;
use crate::{live_streams, objects, page, people, records, replicas, vehicles};

/// Maximum number of open connections of people, and of vehicles: a whole fleet has another one
/// for the files of a deployment. With few descriptors, there are fewer.
const PEOPLE_MAX: usize = 1000;
const VEHICLES_MAX: usize = 40_000;
/// Maximum number of connections that have not shown a vehicle's certificate yet. A vehicle needs
/// less than a second, so 1,536 of a fleet behind one address can begin in that time.
const STRANGERS_MAX: usize = 1536;
/// Time after which a connection ends whose other side takes no byte, in ms.
const UNREAD_MS: u32 = if cfg!(test) { 1000 } else { 60_000 };
/// Interval at which times of signs of life are stored.
const SEEN_INTERVAL: Duration = Duration::from_secs(30);

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
    #[arg(
        long = "http",
        alias = "people",
        value_name = "ADDRESS",
        default_value = "127.0.0.1:8080"
    )]
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
    #[arg(long = "insecure-http", alias = "insecure-people")]
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
             --insecure-http in a network that you trust",
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
        let bus = options.bus.as_deref().map(BusAddress::parse).transpose()?;
        let bucket = options.objects.as_deref().map(S3Bucket::parse).transpose()?;
        options.check_shared()?;
        let objects = bucket.as_ref().map(S3Bucket::url).unwrap_or_default();
        let (store, authorities) = open_store(&folder, options.store.as_deref(), &objects).await?;
        let (people_listener, people) = listen(options.people, "--http").await?;
        let (vehicles_listener, vehicles) = listen(options.vehicles, "--vehicles").await?;
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
                let authority = &authorities.digest()[..16];
                let (bus, hints) = address.connect(authority, &mut chores).await?;
                (bus, Some(hints))
            }
        };
        let tls = watch::Sender::new(authorities.server_config(&host)?);
        let code = store.invite_first().await?.map(|invitation| invitation.code);
        let (store, authorities) = ((Arc::new(store), Hub::new(bus)), (authorities, address));
        let files = (&folder, bucket.as_ref());
        let cloud = Cloud::open(store, files, authorities, options.keep_records_days)?;
        let (stop, (failure, failed)) = (watch::Sender::new(false), watch::channel(None));
        let listeners = [people_listener, vehicles_listener];
        let tls_config = tls.subscribe();
        let entrances = serve(listeners, &cloud, tls_config, options.is_behind_proxy, &stop);
        if cloud.store.is_shared() {
            let is_alone = bucket.is_none();
            spawn(&mut chores, &cloud, move |cloud| async move {
                replicas::keep_lease(&cloud.store, is_alone, failure).await;
            });
            spawn(&mut chores, &cloud, |cloud| async move {
                replicas::follow(&cloud.store, &cloud.hub, hints).await;
            });
        }
        spawn_chores(&mut chores, &cloud);
        spawn(&mut chores, &cloud, |cloud| async move {
            cloud.enrolments.renew_own(&host, &tls).await;
        });
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
            // They show as connected until they time out.
            tracing::warn!(reason = error.reason(), "could not mark vehicles as disconnected");
        }
        cloud.store.close().await;
    }
}

/// Opens the database and the certificates, which belong to each other.
async fn open_store(
    folder: &DataFolder,
    url: Option<&str>,
    objects: &str,
) -> Result<(CloudStore, Authorities), Failure> {
    let address = folder.store(url)?;
    let store = CloudStore::open(&address).await?;
    if !folder.has_authorities() {
        // Those of a new folder would be others than the database has.
        store.tie(None, objects).await?;
    }
    let authorities = Authorities::open(folder)?;
    store.tie(Some(&authorities.digest()), objects).await?;
    folder.keep(&address)?;
    if let Some(seq) = store.first_changed_entry().await? {
        tracing::error!(seq, "audit trail mismatch: an entry differs from what was written");
    }
    Ok((store, authorities))
}

/// Serves people and vehicles, each at a listener.
fn serve(
    [people, vehicles]: [TcpListener; 2],
    cloud: &Arc<Cloud>,
    tls: watch::Receiver<Arc<ServerConfig>>,
    is_behind_proxy: bool,
    stop: &watch::Sender<bool>,
) -> JoinSet<()> {
    let plain = |listener: TcpListener, bound, router: Router| {
        let router = router.layer(map_response(counted));
        BoundedListener::plain(listener.tap_io(tune), bound, router, stop.subscribe())
    };
    let bound = ("people connections", PEOPLE_MAX.min(descriptors(2)));
    let for_people = plain(people, bound, people::router(cloud, page::router(cloud)));
    let bound = ("vehicle connections", STRANGERS_MAX.min(descriptors(2)));
    let for_vehicles = plain(vehicles, bound, vehicles::router(cloud));
    let (tls, known) = (Some(tls), VEHICLES_MAX.min(descriptors(10)));
    let mut entrances = JoinSet::new();
    entrances.spawn(BoundedListener { is_behind_proxy, ..for_people }.serve());
    entrances.spawn(BoundedListener { tls, known, ..for_vehicles }.serve());
    entrances
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

/// Spawns a chore in a task of its own: one that waits for the database must not hold others up.
fn spawn<F: Future<Output = ()> + Send + 'static>(
    chores: &mut JoinSet<()>,
    cloud: &Arc<Cloud>,
    chore: impl FnOnce(Arc<Cloud>) -> F,
) {
    chores.spawn(chore(Arc::clone(cloud)));
}

/// Spawns the chores that a cloud has with and without replicas.
fn spawn_chores(chores: &mut JoinSet<()>, cloud: &Arc<Cloud>) {
    spawn(chores, cloud, |cloud| async move { cloud.clips.clean().await });
    spawn(chores, cloud, |cloud| async move {
        objects::collect(&cloud.objects, &cloud.store).await;
    });
    spawn(chores, cloud, |cloud| async move { records::keep(&cloud.records).await });
    spawn(chores, cloud, |cloud| async move {
        live_streams::keep(&cloud.live_streams, &cloud.store, &cloud.hub).await;
    });
    spawn(chores, cloud, |cloud| async move { cloud.deployments.advance_waves().await });
    spawn(chores, cloud, |cloud| async move {
        let mut ticks = ticks(SEEN_INTERVAL);
        loop {
            ticks.tick().await;
            store_seen(&cloud).await;
        }
    });
}

async fn store_seen(cloud: &Cloud) {
    if let Err(error) = cloud.store.seen(&cloud.hub.take_seen()).await {
        tracing::warn!(reason = error.reason(), "could not save last-seen times");
    }
}

/// Opens a listener, and returns its address.
async fn listen(address: SocketAddr, option: &str) -> Result<(TcpListener, SocketAddr), Failure> {
    let opened = TcpListener::bind(address).await;
    opened.and_then(|it| it.local_addr().map(|local| (it, local))).map_err(|error| {
        Failure::caused_by(Exit::Usage, format!("cannot listen on {address}"), &error)
            .with_help(format!("choose another address with {option}"))
    })
}

/// Returns the host of `HOST:PORT`.
fn host(address: &str) -> Result<&str, Failure> {
    let parts = address.rsplit_once(':').filter(|(_, port)| port.parse::<u16>().is_ok());
    let host = parts.map(|(host, _)| host.trim_start_matches('[').trim_end_matches(']'));
    host.filter(|host| !host.is_empty()).ok_or_else(|| {
        let shown = gleaner_base::excerpt(address);
        Failure::new(Exit::Usage, format!("`{shown}` is not the address of a cloud"))
            .with_help("name a host and a port with --name, as in cloud.example.org:8443")
    })
}

#[cfg(test)]
mod tests {
    use std::io::ErrorKind;

    use axum::serve::Listener;
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
